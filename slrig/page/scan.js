// Scan: what the cameras see, one large button, how far the scan is, and the scans so far.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {Limits, useLimits} from "./limits.js";
import {Live} from "./live.js";
import {NameField, called, useName} from "./names.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Action, JobBadge, Progress, Refusal, count, length} from "./ui.js";

const SHOWN = 12;
const SEQUENCES = {fast: "fast: fewest frames", standard: "standard", robust: "robust: for what reflects or is hollow", phase: "phase: few frames, in shades of grey"};
const over = (scan) => !["queued", "capturing", "computing"].includes(scan.state);

export function ScanScreen({rig, may}) {
  const [list, problem, again] = useValue(`/scan?limit=${SHOWN}`, 5);
  const [bracket, setBracket] = useState(null);
  const [known] = useValue("/preset");
  const [preset, setPreset] = useState("");
  const [sequence, setSequence] = useState("");
  const [typed, region, change] = useLimits();
  const [name, setName, used] = useName();
  const scans = list?.scans ?? [];
  // The oldest that is not over holds the rig, whoever asked for it, and also after this page was loaded anew.
  const active = scans.filter((scan) => !over(scan)).at(-1);
  const [start, busy, refused] = useAction(async () => {
    const body = {if_busy: "queue", ...(preset ? {preset} : {}), ...(sequence ? {patterns: {sequence}} : {}), ...(bracket ? {exposures_s: bracket} : {}), ...(region ? {reconstruction: {region}} : {}), label: name.trim() || null};
    const scan = await ask("POST", "/scan", {body, headers: once()});
    sessionStorage.setItem("asked", scan.id);
    used();
    await again();
  });
  const blocked = !rig ? "The service has not told of the rig yet." : rig.error ?? (rig.calibrated === false ? "The rig has no calibration: a scan would have no millimetres." : null);
  return html`<div class="two">
    <section aria-label="Live picture">
      <${Live} rig=${rig} may=${may} bracket=${bracket} setBracket=${setBracket} />
    </section>
    <section aria-label="Scan">
      ${may("scan") && html`<${NameField} name=${name} change=${setName} entered=${start} />`}
      <${Action} kind="primary large" busy=${busy} disabled=${!may("scan")} onClick=${start}>Scan<//>
      ${may("scan") && known && html`<label>For an object that is <select value=${preset} onChange=${(event) => setPreset(event.target.value)}>
        <option value="">as the rig is set</option>${known.presets.filter(({fault}) => !fault).map(({name}) => html`<option value=${name}>${name}</option>`)}</select></label>`}
      ${may("scan") && html`<label>Patterns <select value=${sequence} onChange=${(event) => setSequence(event.target.value)}>
        <option value="">as the rig is set</option>${Object.entries(SEQUENCES).map(([name, words]) => html`<option value=${name}>${words}</option>`)}</select></label>`}
      ${may("scan") && html`<${Limits} typed=${typed} region=${region} change=${change} others=${preset ? null : rig?.scan_defaults?.region} preset=${preset} />`}
      ${!may("scan") && html`<p class="quiet">Your key is for looking only.</p>`}
      ${blocked && html`<p class="warning">${blocked} ${rig?.calibrated === false && html`<a href="#/calibrate">Calibrate</a>`}</p>`}
      <${Refusal} problem=${refused} />
      ${active && html`<${UnderWay} key=${active.id} scan=${active} changed=${again} may=${may} />`}
      ${!active && scans[0]?.error && html`<${Refusal} problem=${{document: {title: "The last scan failed"}, message: scans[0].error.detail}} />`}
    </section>
  </div>
  <section aria-label="Recent scans">
    <div class="between"><h2>Recent scans</h2><a href="#/scan/all">All scans</a></div>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${list && scans.length === 0 && html`<p class="quiet">No scans yet. Name the part, then press Scan.</p>`}
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
    <div class="between"><strong>${called(scan)}</strong><${JobBadge} state=${state} /></div>
    <${Progress} label=${told.stage} fraction=${told.fraction} detail=${told.detail} />
    ${may("scan") && html`<${Action} busy=${busy} onClick=${cancel}>Stop it<//>`}
    <${Refusal} problem=${problem} />
  </div>`;
}

function Card({scan}) {
  const {picture} = scan.links;
  return html`<li><a class="card" href=${`#/scan/${scan.id}`}>
    ${picture ? html`<img class="alone" src=${picture} alt="" loading="lazy" width="320" height="240" />` : html`<span class="none" aria-hidden="true">No picture</span>`}
    <span class="between"><span class="name">${called(scan)}</span><${JobBadge} state=${scan.state} /></span>
    ${scan.triangles !== null && html`<span class="quiet">${count(scan.triangles)} triangles, σ ${length(scan.sigma_mm)}</span>`}
    ${scan.error && html`<span class="quiet clip">${scan.error.detail}</span>`}
  </a></li>`;
}
