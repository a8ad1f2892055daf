// The rig file: what an examination proposes for it, settings, its text; and opening the rig again.
import {html, useState} from "./vendor/preact-htm.js";
import {ask, useAction} from "./service.js";
import {Action, Refusal} from "./ui.js";

/** Who has the rig, in words: a scan is held by its id alone. */
const inUse = (holder) => `The rig is in use by ${/^[0-9a-f]{8}-/.test(holder) ? "a scan" : `"${holder.replace(/ [0-9a-f-]{36}$/, "")}"`}.`;

/** Why a change cannot be made now; null where it can. */
function hindrance({file, rig, may}) {
  if (!may("administer")) return "Your key may not change the rig file.";
  if (rig?.holder) return inUse(rig.holder);
  return file?.refused ?? null;
}

/** What an examination proposes, as a difference, and a button that takes it over. */
export function Proposed({kind, file, rig, may, changed}) {
  const [before, setBefore] = useState(null);
  const put = async (text, version) => ask("PUT", "/rig/file", {body: {text, version}});
  const proposal = file?.proposals.find((each) => each.kind === kind);
  const [apply, applying, unapplied] = useAction(async () => {
    const was = file.text;
    const {version} = await put(proposal.text, file.version);
    setBefore({text: was, version});
    await changed();
  });
  const [undo, undoing, kept] = useAction(async () => {
    await put(before.text, before.version);
    setBefore(null);
    await changed();
  });
  if (!may("administer")) return html`<p class="quiet">A key with the scope “administer” sees what is proposed for the rig file.</p>`;
  if (!file) return null;
  const why = hindrance({file, rig, may});
  // Of a file that was changed since there is nothing to undo.
  const undoable = before?.version === file.version;
  if (!proposal)
    return html`<p class="quiet" role="status">${undoable ? "Applied. The rig was opened again with the new file." : "The rig file holds what was measured."}
      ${undoable && html` <${Action} busy=${undoing} disabled=${Boolean(why)} onClick=${undo}>Undo<//>`}</p><${Refusal} problem=${kept} />`;
  const [more, less] = ["+", "-"].map((sign) => proposal.difference.filter((line) => line.startsWith(sign)).length);
  return html`<h3>Proposed for the rig file</h3>
    <pre class="difference" tabindex="0" role="region" aria-label="Difference from the rig file">${proposal.difference.map((line) => html`<span class=${KINDS[line[0]] ?? ""}>${line}</span>`)}</pre>
    <div class="row"><${Action} kind="primary" busy=${applying} disabled=${Boolean(why)} onClick=${apply}>Apply to the rig file<//>
      <span class="quiet">${why ?? `${less ? `${more} lines in place of ${less}` : more === 1 ? "One line more" : `${more} lines more`}. The rig is opened again; the old file stays beside the new one.`}</span></div>
    <${Refusal} problem=${unapplied} />`;
}

const KINDS = {"+": "come", "-": "gone", "@": "place"};

/** Close every device and open it again: after a cable came out, or an editor changed the file. */
export function Reopen({rig, may, changed}) {
  const [open, busy, problem] = useAction(async () => {
    await ask("POST", "/rig/reopen");
    await changed();
  });
  const why = !may("calibrate") ? "Your key may not open the rig again." : rig.holder ? inUse(rig.holder) : null;
  return html`<div class="row"><${Action} busy=${busy} disabled=${Boolean(why)} onClick=${open}>Open the rig again<//>
      <span class="quiet">${why ?? "After a cable came out, or the rig file was changed."}</span></div>
    ${busy && html`<p role="status">Every device is closed and opened again …</p>`}
    <${Refusal} problem=${problem} />`;
}

/** The range that all cameras of these settings can do. */
function range(name, rig, key) {
  const ranges = rig.cameras.filter((camera) => name === "head" || camera.name === name).map((camera) => camera[key]);
  return ranges.length ? [Math.max(...ranges.map(([least]) => least)), Math.min(...ranges.map(([, most]) => most))] : [0, Infinity];
}

const short = (value) => Number(value.toPrecision(4));

/** What is wrong with a number that was typed; null where it is right. `empty`: what it means to leave it out. */
function fault(text, [least, most], unit, empty) {
  if (text === "") return empty ? null : "A number is wanted here.";
  const value = Number(text);
  if (!Number.isFinite(value)) return "This is not a number.";
  return value < least || value > most ? `Expected ${short(least)} to ${short(most)}${unit}, found ${short(value)}${unit}.` : null;
}

function Setting({label, value, change, wrong, hint}) {
  return html`<label class="setting">${label}
    <input type="text" inputmode="decimal" value=${value} aria-invalid=${Boolean(wrong)} onInput=${(event) => change(event.target.value.replace(",", ".").trim())} />
    ${wrong ? html`<span class="warning" role="alert">${wrong}</span>` : html`<span class="quiet">${hint}</span>`}</label>`;
}

/** Exposures, gains, tolerance: what a rig that is opened again takes up. */
export function Settings({file, rig, may, changed}) {
  const [typed, setTyped] = useState({});
  const {settings} = file;
  const shown = (key, value) => typed[key] ?? (value === null ? "" : String(short(value)));
  const wrongs = {};
  const names = Object.keys(settings?.cameras ?? {});
  const fields = names.flatMap((name) => ["exposure_s", "gain"].map((key) => {
    const unit = key === "gain" ? "" : "\u00a0ms";
    const factor = key === "gain" ? 1 : 1000;
    const at = `cameras.${name}.${key}`;
    const kept = settings.cameras[name][key];
    const text = shown(at, kept === null ? null : kept * factor);
    const limits = range(name, rig, key === "gain" ? "gain_range" : "exposure_range_s").map((value) => value * factor);
    wrongs[at] = fault(text, limits, unit, key === "exposure_s");
    const whose = name === "head" ? "" : ` of ${name}`;
    return {at, name, key, factor, text, label: key === "gain" ? `Gain${whose}` : `Exposure${whose}, ms`, hint: `${Number.isFinite(limits[1]) ? `${short(limits[0])} to ${short(limits[1])}${unit}` : "the rig is not open"}${key === "gain" ? "" : "; empty: 1/60 s"}`};
  }));
  const tolerance = shown("tolerance_mm", settings?.tolerance_mm ?? null);
  wrongs.tolerance_mm = fault(tolerance, [0.0001, 1000], "\u00a0mm", true);
  const stale = typed.stale ?? settings?.refuse_when_stale ?? false;
  const [save, busy, problem] = useAction(async () => {
    const cameras = Object.fromEntries(names.map((name) => [name, {}]));
    for (const {name, key, factor, text, at} of fields) cameras[name][key] = typed[at] === undefined ? settings.cameras[name][key] : text === "" ? null : Number(text) / factor;
    await ask("PUT", "/rig/settings", {body: {cameras, tolerance_mm: tolerance === "" ? null : Number(tolerance), refuse_when_stale: stale, version: file.version}});
    setTyped({});
    await changed();
  });
  if (!settings) return null;
  const told = Object.fromEntries((problem?.document.errors ?? []).map((each) => [each.field, each.message]));
  const change = (at) => (value) => setTyped((before) => ({...before, [at]: value}));
  const why = hindrance({file, rig, may});
  return html`<details><summary>Change settings</summary>
    <form onSubmit=${(event) => (event.preventDefault(), save())}>
      <div class="row numbers">${fields.map(({at, text, label, hint}) => html`<${Setting} key=${at} label=${label} value=${text} change=${change(at)} wrong=${wrongs[at] ?? told[at]} hint=${hint} />`)}
        <${Setting} label="Tolerance of a point, mm" value=${tolerance} change=${change("tolerance_mm")} wrong=${wrongs.tolerance_mm ?? told.tolerance_mm} hint="95 of 100 points are to be better; empty: not said" /></div>
      <p><label class="tick"><input type="checkbox" checked=${stale} onChange=${(event) => change("stale")(event.target.checked)} /> Refuse scans while the calibration is stale</label></p>
      <div class="row"><button class="action primary" type="submit" aria-busy=${busy} disabled=${busy || Boolean(why) || Object.keys(typed).length === 0 || Object.values(wrongs).some(Boolean)}>Save and open the rig again</button>
        <span class="quiet">${why ?? "Scans that state an exposure of their own are not affected."}</span></div>
      <${Refusal} problem=${problem && !problem.document.errors ? problem : null} />
    </form></details>`;
}

/** The whole file, for those who know it. */
export function FileText({file, rig, may, changed}) {
  const [typed, setTyped] = useState(null);
  const [save, busy, problem] = useAction(async () => {
    await ask("PUT", "/rig/file", {body: {text: typed.text, version: typed.version}});
    setTyped(null);
    await changed();
  });
  const why = hindrance({file, rig, may});
  return html`<details><summary>The rig file</summary>
    <p class="quiet"><code>${file.path}</code></p>
    ${file.fault && html`<p class="warning">As it lies there now it is not right: ${file.fault}</p>`}
    <textarea class="file" aria-label="Text of the rig file" spellcheck="false" rows="16" value=${typed?.text ?? file.text} readonly=${Boolean(why)}
      onInput=${({target}) => setTyped((before) => ({text: target.value, version: before?.version ?? file.version}))}></textarea>
    <div class="row"><${Action} busy=${busy} disabled=${typed === null || Boolean(why)} onClick=${save}>Save and open the rig again<//>
      ${typed !== null && html`<${Action} onClick=${() => setTyped(null)}>Discard my changes<//>`}
      <span class="quiet">${why ?? "A file by which the rig does not open is refused, and the old one stays."}</span></div>
    <${Refusal} problem=${problem} /></details>`;
}
