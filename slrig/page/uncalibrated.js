// Scans of a rig without a calibration: what is known of its devices, what the scan found, and how it becomes the rig's calibration.
import {html, useState} from "./vendor/preact-htm.js";
import {ask, useAction} from "./service.js";
import {Action, Choice, Facts, Field, Refusal, count, length, number, percent} from "./ui.js";

const KEPT = "guess";
/** How long one is where its length is not known: lengths are in hundredths of it. */
const BASELINE = 100;
const USUAL = {by: "px", cameras: {}, focalOff: "", throwRatio: "", throwOff: "", baseline: "", baselineOff: "", most: ""};
const BY = [["px", "In pixels"], ["lens", "By lens and pixel size"]];

/** Focal length in pixels of what is typed of a camera; undefined where it is not known. */
function focalPx(by, {focal, lens, pixel} = {}) {
  const px = by === "lens" ? 1000 * lens / pixel : Number(focal);
  return px > 0 && Number.isFinite(px) ? px : undefined;
}

/** What is typed as a request has it; what is not typed is left out. */
export function guessed({by, cameras, focalOff, throwRatio, throwOff, baseline, baselineOff, most}, names) {
  const known = names.map((name) => [name, focalPx(by, cameras[name])]).filter(([, px]) => px);
  const share = (typed) => Number(typed) ? Number(typed) / 100 : undefined;
  const all = {
    focal_px: Object.fromEntries(known), focal_sigma: share(focalOff), throw_ratio: Number(throwRatio) || undefined, throw_sigma: share(throwOff),
    baseline_mm: Number(baseline) || undefined, baseline_sigma: share(baselineOff), most_error: share(most),
  };
  return Object.fromEntries(Object.entries(all).filter(([, value]) => value !== undefined));
}

/** The reverse: a guess as it would be typed. */
export function typedOf({focal_px, focal_sigma, throw_ratio, throw_sigma, baseline_mm, baseline_sigma, most_error}) {
  const written = (value, size = 1) => value ? String(Number((value * size).toPrecision(6))) : "";
  return {
    by: "px", cameras: Object.fromEntries(Object.entries(focal_px).map(([name, px]) => [name, {focal: written(px)}])), focalOff: written(focal_sigma, 100),
    throwRatio: written(throw_ratio), throwOff: written(throw_sigma, 100), baseline: written(baseline_mm), baselineOff: written(baseline_sigma, 100), most: written(most_error, 100),
  };
}

/** The error of shape to allow, a share, so that what was refused is made, where a larger one helps; null of any other refusal. */
export function allowable(words) {
  const stated = /determines the shape to ([\d.]+)%.*allow a larger error/s.exec(words ?? "");
  // It states hundredths of a percent, rounded.
  return stated && (Math.round(100 * stated[1]) + 1) / 1e4;
}

/** A guess after a known length told the factor of all lengths and its relative σ: the baseline is as much longer, and in mm. */
export const rescaled = (guess, {factor, sigma}) => ({...guess, baseline_mm: (guess.baseline_mm ?? BASELINE) * factor, baseline_sigma: sigma});

/** Have a scan made again from its frames, by other guesses. */
export const computeAgain = (scan, guess) => ask("POST", `${scan.links.self}/reconstruct`, {body: {uncalibrated: guess}});

/** What is known of the devices: fields that may all stay empty. */
function Guesses({names, typed, change}) {
  const of = (name) => ({value: typed[name], change: (value) => change({...typed, [name]: value})});
  const camera = (name, key) => ({
    value: typed.cameras[name]?.[key] ?? "", change: (value) => change({...typed, cameras: {...typed.cameras, [name]: {...typed.cameras[name], [key]: value}}}),
  });
  const px = (name) => focalPx(typed.by, typed.cameras[name]);
  return html`<div class="row"><span>Focal length</span><${Choice} label="Focal length" value=${typed.by} options=${BY} chosen=${of("by").change} /></div>
    ${typed.by === "px" ? html`<div class="row numbers">${names.map((name) => html`<${Field} key=${name} label=${`Camera ${name}, px`} ...${camera(name, "focal")} placeholder="not known" />`)}
      <${Field} label="Right within, %" ...${of("focalOff")} max="100" placeholder="10" /></div>`
      : names.map((name) => html`<div key=${name} class="row numbers"><${Field} label=${`Lens of ${name}, mm`} ...${camera(name, "lens")} required=${Boolean(typed.cameras[name]?.pixel)} placeholder="not known" />
        <${Field} label=${`Pixel of ${name}, µm`} ...${camera(name, "pixel")} required=${Boolean(typed.cameras[name]?.lens)} placeholder="not known" />
        ${px(name) && html`<span class="quiet">= ${number(px(name), {digits: 4})} px</span>`}</div>`)}
    ${typed.by === "lens" && html`<div class="row numbers"><${Field} label="Right within, %" ...${of("focalOff")} max="100" placeholder="10" /></div>`}
    <div class="row numbers"><${Field} label="Projector: distance over width" ...${of("throwRatio")} max="100" placeholder="not known" />
      <${Field} label="Right within, %" ...${of("throwOff")} max="100" placeholder="10" /></div>
    <div class="row numbers"><${Field} label="First camera to projector, mm" ...${of("baseline")} placeholder="not known" />
      <${Field} label="Right within, %" ...${of("baselineOff")} max="100" placeholder="1" /></div>
    <div class="row numbers"><${Field} label="Refuse errors of shape above, %" ...${of("most")} max="100" placeholder="0.15" /></div>
    <p class="quiet">All may stay empty. Focal lengths within 2 % usually give an error of 0.3 % of the scene's size, within 10 % about 0.5 %. Without the distance of first camera
      and projector, lens to lens, lengths are in hundredths of it, not in mm.</p>`;
}

/** A first scan of a rig that is not calibrated. `start` scans by a guess; `blocked`: why it cannot begin, or null. */
export function FirstScan({rig, start, busy, blocked}) {
  const [typed, setTyped] = useState(() => ({...USUAL, ...JSON.parse(localStorage.getItem(KEPT) ?? "{}")}));
  const names = rig.cameras.map(({name}) => name);
  const submit = (event) => {
    event.preventDefault();
    localStorage.setItem(KEPT, JSON.stringify(typed));
    start(guessed(typed, names));
  };
  return html`<form onSubmit=${submit}>
    <p class="quiet">The scan calibrates the rig by itself, and states the error of its shape. Put something with depth before the rig: a box with a corner towards it, or several things one
      behind the other. For less error, calibrate with a board.</p>
    <${Guesses} names=${names} typed=${typed} change=${setTyped} />
    ${blocked && html`<p class="warning">${blocked.words} ${blocked.help && html`<a href=${blocked.help[0]}>${blocked.help[1]}</a>`}</p>`}
    <button class="action primary" type="submit" aria-busy=${busy} disabled=${busy || Boolean(blocked)}>Scan without a calibration</button>
  </form>`;
}

/** After a refusal: the same frames by other guesses. `changed` is called once they are computed. */
export function OtherGuesses({scan, rig, changed}) {
  const before = scan.plan.reconstruction.uncalibrated;
  const allowed = allowable(scan.error?.detail);
  const [typed, setTyped] = useState(() => typedOf(before));
  const names = [...new Set([...(rig?.cameras ?? []).map(({name}) => name), ...Object.keys(before.focal_px)])];
  const [compute, busy, refused] = useAction((guess) => computeAgain(scan, guess).then(changed));
  const submit = (event) => {
    event.preventDefault();
    compute(guessed(typed, names));
  };
  return html`<div class="box">
    ${allowed && html`<p>For a first look the error may be allowed. Nothing has to be shot again.</p>
      <p><${Action} kind="primary" busy=${busy} onClick=${() => compute({...before, most_error: allowed})}>Allow ${percent(allowed)} and compute again<//></p>`}
    <details><summary>Say more of the devices</summary><form onSubmit=${submit}><${Guesses} names=${names} typed=${typed} change=${setTyped} />
      <button class="action" type="submit" aria-busy=${busy} disabled=${busy}>Compute again with these</button></form></details>
    <${Refusal} problem=${refused} /></div>`;
}

/** The calibration that a scan found: its error, its unit, and how to make it that of the rig. */
export function FoundCalibration({scan, report, rig, may, over, changed}) {
  const {shape_error: error, shape_error_mm: errorLength, size_mm: size, unit, scale_sigma: scale, focal_changed: focal, pairs} = report.self_calibration;
  const guess = report.plan.uncalibrated;
  const inMm = unit === "mm";
  const [baseline, setBaseline] = useState("");
  const [compute, busy, refused] = useAction(() => computeAgain(scan, {...guess, baseline_mm: Number(baseline)}).then(changed));
  const [use, using, unused] = useAction(async () => {
    const file = JSON.stringify(await ask("GET", scan.links.files["calibration.json"]));
    const label = `Found by scan${scan.label ? ` ${scan.label}` : ""}`.slice(0, 100);
    const made = await ask("POST", `/calibration/import?${new URLSearchParams({label})}`, {file, headers: {"Content-Type": "application/json"}});
    await ask("POST", `/calibration/${made.id}/activate`);
  });
  const submit = (event) => {
    event.preventDefault();
    compute();
  };
  const used = rig?.calibration && rig.calibration.solve === report.calibration.id;
  const lengths = inMm ? "mm" : "hundredths of the baseline";
  return html`<p>This scan calibrated the rig by itself, without a board.</p>
    <${Facts} of=${[
      ["Error of its shape (1 σ)", `${percent(error)} of its size: ${number(errorLength, {digits: 2})} of ${number(size)} ${lengths}`],
      ["Unit of all lengths", inMm ? `mm: the baseline is ${length(guess.baseline_mm)}` : "hundredths of the distance from the first camera to the projector"],
      ["The size may be wrong by (1 σ)", inMm ? percent(scale) : null],
      ...Object.entries(focal).map(([name, change]) => [`Focal length of ${name}`, `${change < 0 ? "−" : "+"}${percent(Math.abs(change))} from the guess`]),
      ["Pixels compared", count(pairs)],
    ]} />
    ${!inMm && over && html`<form onSubmit=${submit}><p class="warning">These lengths are no millimetres. Measure something whose length you know (Measure, Distance) and say how long it is; or say how far the first
      camera is from the projector, lens to lens.</p>
      <div class="row numbers"><${Field} label="First camera to projector, mm" value=${baseline} change=${setBaseline} required />
        <button class="action" type="submit" aria-busy=${busy} disabled=${busy || !may("scan")}>Compute again in mm</button></div></form>`}
    <${Refusal} problem=${refused} />
    ${used ? html`<p role="status">The rig uses this calibration. <a href="#/scan">Scan</a> with it, or <a href=${rig.calibration.id ? `#/calibrate/${rig.calibration.id}` : "#/calibrate"}>look at it</a>.</p>`
      : inMm && over && html`<div class="row"><${Action} kind="primary" busy=${using} disabled=${!may("calibrate")} onClick=${use}>Use it as the rig's calibration<//>
        <span class="quiet">${may("calibrate") ? "Scans use it from the next one on, and state its error." : "This takes a key with the scope “calibrate”."}</span></div>`}
    <${Refusal} problem=${unused} />`;
}
