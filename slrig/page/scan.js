// Scan: what the cameras see fills the stage; beside it one large button, light and focus, and the scans so far.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {Exposure} from "./exposure.js";
import {Limits, useLimits} from "./limits.js";
import {Live} from "./live.js";
import {NameField, called, useName} from "./names.js";
import {whyNot} from "./ready.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Action, JobBadge, Progress, Refusal, begun, count, length} from "./ui.js";
import {FirstScan} from "./uncalibrated.js";
import {Panel, Workspace} from "./workspace.js";

const SHOWN = 8;
const SEQUENCES = {fast: "Fast: fewest frames", standard: "Standard", robust: "Robust: for what reflects or is hollow", phase: "Phase: few frames, in shades of grey"};
const over = (scan) => !["queued", "capturing", "computing"].includes(scan.state);

export function ScanScreen({rig, may}) {
  const [list, problem, again] = useValue(`/scan?limit=${SHOWN}`, 5);
  const [exposures_s, setExposures] = useState(null);
  const [figures, setFigures] = useState(null);
  const [known] = useValue("/preset");
  const [preset, setPreset] = useState("");
  const [sequence, setSequence] = useState("");
  const [typed, region, change] = useLimits();
  const [name, setName, used] = useName();
  const scans = list?.scans ?? [];
  // The oldest that is not over holds the rig, whoever asked for it, and also after this page was loaded anew.
  const active = scans.filter((scan) => !over(scan)).at(-1);
  const patterned = {...(preset ? {preset} : {}), ...(sequence ? {patterns: {sequence}} : {})};
  const [start, busy, refused] = useAction(async (uncalibrated) => {
    const exposing = exposures_s?.length > 1 ? {exposures_s} : exposures_s ? {exposure_s: exposures_s[0]} : {};
    const body = {if_busy: "queue", ...patterned, ...exposing, reconstruction: {...(region ? {region} : {}), ...(uncalibrated ? {uncalibrated} : {})}, label: name.trim() || null};
    const scan = await ask("POST", "/scan", {body, headers: once()});
    sessionStorage.setItem("asked", scan.id);
    used();
    await again();
  });
  const blocked = whyNot(rig, may);
  const open = may("scan") && rig?.open && rig.calibrated === false;
  const presets = known?.presets.filter(({fault}) => !fault) ?? [];
  const stage = html`<${Live} rig=${rig} may=${may} exposure_s=${exposures_s?.[0]} limits=${{...(preset ? {preset} : {}), ...(region ? {region} : {})}} told=${setFigures} />
    ${active && html`<div class="over middle"><${UnderWay} key=${active.id} scan=${active} changed=${again} may=${may} /></div>`}`;
  const last = scans.find((scan) => scan.triangles !== null);
  return html`<${Workspace} label="Live picture" stage=${stage} top=${html`
      ${last && html`<a class="action" href=${`#/scan/${last.id}`}>Last mesh</a>`}
      <span class="alone"><${Action} kind="primary" busy=${busy} disabled=${Boolean(blocked)} onClick=${() => start()}>Scan<//></span>`}>
    <section aria-label="Scan" class="head">
      <h2>New scan</h2>
      ${may("scan") && html`<${NameField} name=${name} change=${setName} entered=${() => blocked || start()} />`}
      <${Action} kind="primary large" busy=${busy} disabled=${Boolean(blocked)} aria-describedby=${blocked && "why-not"} onClick=${() => start()}>Scan<//>
      ${blocked && html`<p id="why-not" class=${may("scan") ? "warning" : "quiet"}>${blocked.words} ${blocked.help && html`<a href=${blocked.help[0]}>${blocked.help[1]}</a>`}${open && " Or scan without a calibration, below."}</p>`}
      ${rig?.error && html`<p class="warning">${rig.error} The next scan tries to open the rig again.</p>`}
      <${Refusal} problem=${refused} />
      ${!active && scans[0]?.error && html`<${Refusal} problem=${{document: {title: "The last scan failed"}, message: scans[0].error.detail}}><a href=${`#/scan/${scans[0].id}`}>What to do now</a><//>`}
      ${may("scan") && html`<div class="row numbers">${known && html`<label>Preset <select value=${preset} onChange=${(event) => setPreset(event.target.value)}>
        <option value="">Rig default</option>${presets.map(({name, description}) => html`<option value=${name}>${begun(name)}${description ? `: ${description}` : ""}</option>`)}</select></label>`}
      <label>Patterns <select value=${sequence} onChange=${(event) => setSequence(event.target.value)}>
        <option value="">${preset ? "Preset's, or rig default" : "Rig default"}</option>${Object.entries(SEQUENCES).map(([name, words]) => html`<option value=${name}>${words}</option>`)}</select></label></div>`}
    </section>
    ${open && html`<${Panel} name="Without a calibration"><${FirstScan} rig=${rig} start=${start} busy=${busy} blocked=${whyNot({...rig, calibrated: true}, may)} /><//>`}
    ${may("scan") && rig?.cameras.length > 0 && html`<${Panel} name="Exposure and focus"><${Exposure} rig=${rig} figures=${figures} exposures_s=${exposures_s} setExposures=${setExposures} request=${patterned} robust=${sequence ? null : () => setSequence("robust")} /><//>`}
    ${may("scan") && html`<${Limits} typed=${typed} region=${region} change=${change} others=${preset ? null : rig?.scan_defaults?.region} preset=${preset} />`}
    <section aria-label="Recent scans">
      <div class="between"><h3>Recent scans</h3><a href="#/scan/all">All scans</a></div>
      <${Refusal} problem=${problem?.status ? problem : null} />
      ${list && scans.length === 0 && html`<p class="quiet">No scans yet. Name the part, then press Scan.</p>`}
      <ul class="cards many">${scans.filter(over).map((scan) => html`<${Card} key=${scan.id} scan=${scan} />`)}</ul>
    </section>
  <//>`;
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
    ${scan.triangles !== null && html`<span class="quiet">${count(scan.triangles)} triangles, σ ${length(scan.sigma_mm, scan.unit)}</span>`}
    ${scan.error && html`<span class="quiet clip">${scan.error.detail}</span>`}
  </a></li>`;
}
