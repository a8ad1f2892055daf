// Scan: what the cameras see, one large button, how far the scan is, and the scans so far.
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Action, Choice, JobBadge, Progress, Refusal, count, length, moment, percent} from "./ui.js";

const SHOWN = 12;
const over = (scan) => !["queued", "capturing", "computing"].includes(scan.state);

export function ScanScreen({rig, may}) {
  const [list, problem, again] = useValue(`/scan?limit=${SHOWN}`, 5);
  const [bracket, setBracket] = useState(null);
  const scans = list?.scans ?? [];
  // The oldest that is not over holds the rig, whoever asked for it, and also after this page was loaded anew.
  const active = scans.filter((scan) => !over(scan)).at(-1);
  const [start, busy, refused] = useAction(async () => {
    const body = {if_busy: "queue", ...(bracket ? {exposures_s: bracket} : {})};
    const scan = await ask("POST", "/scan", {body, headers: once()});
    sessionStorage.setItem("asked", scan.id);
    await again();
  });
  const blocked = !rig ? "The service has not told of the rig yet." : rig.error ?? (rig.calibrated === false ? "The rig has no calibration: a scan would have no millimetres." : null);
  return html`<div class="two">
    <section aria-label="Live picture">
      <${Live} rig=${rig} may=${may} bracket=${bracket} setBracket=${setBracket} />
    </section>
    <section aria-label="Scan">
      <${Action} kind="primary large" busy=${busy} disabled=${!may("scan")} onClick=${start}>Scan<//>
      ${!may("scan") && html`<p class="quiet">Your key is for looking only.</p>`}
      ${blocked && html`<p class="warning">${blocked} ${rig?.calibrated === false && html`<a href="#/calibrate">Calibrate</a>`}</p>`}
      <${Refusal} problem=${refused} />
      ${active && html`<${UnderWay} key=${active.id} scan=${active} changed=${again} may=${may} />`}
      ${!active && scans[0]?.error && html`<${Refusal} problem=${{document: {title: "The last scan failed"}, message: scans[0].error.detail}} />`}
    </section>
  </div>
  <section aria-label="Recent scans">
    <h2>Recent scans</h2>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${list && scans.length === 0 && html`<p class="quiet">None yet. The button above makes the first.</p>`}
    <ul class="cards">${scans.filter(over).map((scan) => html`<${Card} key=${scan.id} scan=${scan} />`)}</ul>
  </section>`;
}

/** A scan on its way. When it was asked for here, its result is shown as soon as there is a mesh. */
function UnderWay({scan, changed, may}) {
  const [told, setTold] = useState(scan.progress);
  const [state, setState] = useState(scan.state);
  useEffect(() => follow(scan.links.events, (kind, data) => {
    if (kind === "progress") setTold(data);
    if (kind === "state") setState(data.state);
    const mine = sessionStorage.getItem("asked") === scan.id;
    if (mine && kind === "file" && data.name === "mesh.ply") {
      sessionStorage.removeItem("asked");
      location.hash = `#/scan/${scan.id}`;
    }
  }, changed), [scan.id]);
  const [cancel, busy, problem] = useAction(() => ask("POST", scan.links.cancel));
  return html`<div class="box">
    <div class="between"><strong>${scan.label ?? "Scan"}</strong><${JobBadge} state=${state} /></div>
    <${Progress} label=${told.stage} fraction=${told.fraction} detail=${told.detail} />
    ${may("scan") && html`<${Action} busy=${busy} onClick=${cancel}>Stop it<//>`}
    <${Refusal} problem=${problem} />
  </div>`;
}

function Card({scan}) {
  const figures = scan.summary?.mesh?.figures;
  const sigma_mm = scan.summary?.mesh?.sigma_mm?.p50;
  const picture = scan.links.files["preview.png"];
  return html`<li><a class="card" href=${`#/scan/${scan.id}`}>
    ${picture ? html`<img src=${picture} alt="" loading="lazy" />` : html`<span class="none" aria-hidden="true">no picture</span>`}
    <span class="between"><span>${scan.label ?? moment(scan.created_at)}</span><${JobBadge} state=${scan.state} /></span>
    ${figures && html`<span class="quiet">${count(figures.triangles)} triangles, σ ${length(sigma_mm)}</span>`}
    ${scan.error && html`<span class="quiet clip">${scan.error.detail}</span>`}
  </a></li>`;
}

/** What a camera sees while nobody scans. Looking takes the rig between scans, so it is asked for, never begun by itself. */
function Live({rig, may, bracket, setBracket}) {
  const [camera, setCamera] = useState(null);
  const [light, setLight] = useState("white");
  const [failed, setFailed] = useState(false);
  const image = useRef();
  const names = rig?.cameras.map((each) => each.name) ?? [];
  const seen = camera !== null && names.includes(camera) ? camera : null;
  if (!may("scan")) return html`<p class="quiet">A key for scans shows the live picture.</p>`;
  return html`
    <div class="row">
      <${Choice} label="Camera" value=${seen} options=${[[null, "Off"], ...names.map((name) => [name, name])]} chosen=${(name) => { setCamera(name); setFailed(false); }} />
      ${seen && html`<${Choice} label="Projector" value=${light} options=${[["white", "White light"], ["off", "Dark"]]} chosen=${setLight} />`}
    </div>
    ${!seen && html`<p class="live none">Choose a camera to see what it sees.</p>`}
    ${seen && failed && html`<p class="live none" role="alert">No picture comes. ${rig.error ?? "Choose the camera again to try once more."}</p>`}
    ${seen && !failed && html`<${Picture} key=${`${seen} ${light}`} image=${image} camera=${seen} light=${light} failed=${() => setFailed(true)} />
      <p class="legend"><span class="swatch saturated"></span>saturated <span class="swatch dark"></span>too dark ${rig.holder && " · waits while the rig is held"}</p>
      ${light === "white" && html`<${Exposure} image=${image} camera=${rig.cameras.find((each) => each.name === seen)} bracket=${bracket} setBracket=${setBracket} />`}`}`;
}

function Picture({image, camera, light, failed}) {
  // A picture that is no more shown would go on loading, and the projector would stay lit.
  useEffect(() => {
    const shown = image.current;
    return () => shown.removeAttribute("src");
  }, []);
  return html`<img class="live" ref=${image} src=${`/preview/${encodeURIComponent(camera)}?light=${light}&marks=true`}
    alt=${`Live picture of camera ${camera}`} onError=${failed} />`;
}

/** Of the picture: less is a highlight or two. */
const LEAST_SATURATED = 0.002;
/** Two exposures this many times apart share two thirds of the range of 8 bits. */
const STEP = 4;

/** What the marks in the live picture say of the exposure, and a bracket where one exposure cannot do. */
function Exposure({image, camera, bracket, setBracket}) {
  const [shares, setShares] = useState(null);
  useEffect(() => {
    const timer = setInterval(() => setShares(marked(image.current)), 1000);
    return () => clearInterval(timer);
  }, [camera.name]);
  if (!shares) return null;
  const now_s = camera.exposure_s;
  const shorter_s = now_s / STEP;
  const proposed = shares.saturated > LEAST_SATURATED && shorter_s >= camera.exposure_range_s[0] ? [shorter_s, now_s] : null;
  return html`<p>${percent(shares.saturated)} saturated, ${percent(shares.dark)} too dark or in shadow${now_s ? `, at ${milliseconds(now_s)}` : ""}.
    ${!bracket && proposed && html` <${Action} onClick=${() => setBracket(proposed)}>Scan with ${proposed.map(milliseconds).join(" and ")}<//>`}
    ${bracket && html` Each scan takes ${bracket.map(milliseconds).join(" and ")}. <${Action} onClick=${() => setBracket(null)}>One exposure again<//>`}</p>`;
}

const milliseconds = (seconds) => `${Number((1000 * seconds).toPrecision(3))} ms`;

/** Shares of a picture's pixels that are marked as saturated (red) and as too dark (blue); null before there is one. */
function marked(image) {
  if (!image?.naturalWidth) return null;
  const canvas = document.createElement("canvas");
  canvas.width = 240;
  canvas.height = Math.max(1, Math.round((240 * image.naturalHeight) / image.naturalWidth));
  const context = canvas.getContext("2d", {willReadFrequently: true});
  context.imageSmoothingEnabled = false;
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  const {data} = context.getImageData(0, 0, canvas.width, canvas.height);
  let saturated = 0;
  let dark = 0;
  for (let at = 0; at < data.length; at += 4) {
    if (data[at] > data[at + 1] + 80) saturated += 1;
    if (data[at + 2] > data[at + 1] + 60) dark += 1;
  }
  return {saturated: (4 * saturated) / data.length, dark: (4 * dark) / data.length};
}
