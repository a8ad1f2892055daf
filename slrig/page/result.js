// A scan's result: its mesh, its figures, why pixels are missing, its files, and another scan beside it.
import {Causes} from "./causes.js";
import {Downloads} from "./downloads.js";
import {Keeping} from "./keeping.js";
import {limitToBox, limits} from "./limits.js";
import {Mesh, loadDrawing} from "./mesh.js";
import {NameHeading} from "./names.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Action, Facts, JobBadge, Progress, Refusal, count, length, moment, percent} from "./ui.js";
import {FoundCalibration, OtherGuesses, computeAgain, rescaled} from "./uncalibrated.js";
import {Panel, Workspace} from "./workspace.js";
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";

const OVER = ["succeeded", "failed", "cancelled", "interrupted"];
const MESH = "mesh.ply";
const LOOK_AGAIN_S = 10;

export function ResultScreen({id, rig, may}) {
  const [scan, problem, again] = useValue(`/scan/${encodeURIComponent(id)}`, LOOK_AGAIN_S);
  const made = useRef([]);
  useEffect(() => {
    loadDrawing().catch(() => {});
  }, []);
  if (problem?.status === 404 || problem?.status === 422)
    return html`<${Back} /><${Refusal} problem=${{document: {title: "Scan not found"}, message: "It was deleted, or the address is not right."}} />`;
  if (!scan) return html`<${Back} /><${Refusal} problem=${problem} />${!problem && html`<p class="wait">Asking for the scan …</p>`}`;
  // What was computed again is fetched again, where there was a mesh before.
  if (scan.finished_at && MESH in scan.links.files && made.current.at(-1) !== scan.finished_at) made.current.push(scan.finished_at);
  return html`<${Result} key=${Math.max(made.current.length, 1)} scan=${scan} rig=${rig} again=${again} may=${may} />`;
}

const Back = () => html`<p><a href="#/scan/all">All scans</a> · <a href="#/scan">Live picture</a></p>`;

function Result({scan: asked, rig, again, may}) {
  const {files} = asked.links;
  const over = OVER.includes(asked.state);
  const [told, setTold] = useState(asked.progress);
  const [report, refused] = useValue(files["report.json"] ?? null);
  // While a scan is computed again, and where that failed, its files are those of before.
  const own = report?.self_calibration;
  const scan = own ? {...asked, unit: own.unit === "mm" ? "mm" : "% of baseline"} : asked;
  const [calibration] = useValue(files["calibration.json"] ?? null);
  const [other, setOther] = useState(null);
  const [pointed, point] = useState(null);
  useEffect(() => over ? undefined : follow(scan.links.events, (kind, data) => {
    if (kind === "progress") setTold(data);
    else again();
  }, again), [over]);
  const hasMesh = MESH in files;
  const progress = !over && html`<div class="box">
    ${hasMesh && html`<p role="status">${report ? "It is being computed again; this is the result of before." : "The mesh is ready. The other files are being computed."}</p>`}
    <${Progress} label=${told.stage} fraction=${told.fraction} detail=${told.detail} /></div>`;
  const head = html`<div class="head"><${Back} />
      <${NameHeading} job=${scan} kind="Scan" may=${may("scan")} again=${again}><${JobBadge} state=${scan.state} /><//>
      ${Object.keys(files).length > 0 && html`<${Downloads} files=${files} />`}</div><${Refusal} problem=${refused} />
      ${over && hasMesh && scan.error && html`<${Refusal} problem=${{document: scan.error, message: scan.error.detail}}><p>What is shown was made before.</p><//>`}`;
  const panels = html`${hasMesh && own && html`<${Panel} name="Calibration by this scan"><${FoundCalibration} scan=${scan} report=${report} rig=${rig} may=${may} over=${over} changed=${again} /><//>`}
    ${hasMesh && html`<${Panel} name="Figures"><${Figures} scan=${scan} report=${report} /><//>`}
    ${report && Object.entries(report.cameras).map(([name, camera]) => html`<${Panel} key=${name} name=${`Camera ${name}`}>
      <${Causes} camera=${name} told=${camera} causes=${report.causes} files=${files} device=${calibration?.cameras[name] ?? null} pointed=${pointed} point=${point} /><//>`)}
    ${over && hasMesh && html`<${Panel} name="Compare"><${Compare} scan=${scan} chosen=${setOther} /><//>`}
    <${Panel} name="Keep or delete">${may("scan") && html`<${Keeping} job=${scan} kind="scan" over=${over} again=${again} />`}<//>`;
  const rescale = own && may("scan") && over && files["bundle.zip"] ? (scale) => computeAgain(scan, rescaled(report.plan.uncalibrated, scale)).then(again) : null;
  if (hasMesh)
    return html`<${Mesh} key=${scan.id} scan=${scan} other=${other} report=${report} calibration=${calibration} again=${may("scan") ? limitToBox : null} over=${progress}
      pointed=${pointed} point=${point} rescale=${rescale} head=${head}>${panels}<//>`;
  return html`<${Workspace} label="Mesh" stage=${html`<div class="over middle">${over ? html`<${Ended} scan=${scan} rig=${rig} again=${again} may=${may} />` : progress}</div>`}>${head}${panels}<//>`;
}

/** A scan without a mesh: why, and what now. */
function Ended({scan, rig, again, may}) {
  const titles = {failed: "The scan failed", cancelled: "The scan was stopped", interrupted: "The service ended while it scanned"};
  const [repeat, busy, problem] = useAction(async () => {
    // Not to be asked for: the service fills it in from its hand-eye calibration.
    const {series, patterns: {codes, ...patterns}, reconstruction: {rig_in_base, ...reconstruction}, ...plan} = scan.plan;
    const made = await ask("POST", "/scan", {body: {...plan, patterns, reconstruction, label: scan.label, if_busy: "queue"}, headers: once()});
    sessionStorage.setItem("asked", made.id);
    location.hash = "#/scan";
  });
  const guesses = may("scan") && scan.links.files["bundle.zip"] && scan.plan?.reconstruction.uncalibrated;
  const [anew, making, refused] = useAction(() => ask("POST", `/scan/${scan.id}/reconstruct`).then(again));
  return html`<${Refusal} problem=${{document: {title: titles[scan.state] ?? "There is no mesh"}, message: scan.error?.detail ?? "It gave no mesh."}}>
      ${scan.links.files["bundle.zip"] && html`<p>Its frames are kept: the bundle can be downloaded, to reconstruct it elsewhere or to ask for help.</p>`}
    <//>
    ${guesses && html`<${OtherGuesses} scan=${scan} rig=${rig} changed=${again} />`}
    ${may("scan") && !guesses && scan.links.files["bundle.zip"] && html`<${Action} busy=${making} onClick=${anew}>Reconstruct again<//>`}
    ${may("scan") && scan.plan && html`<${Action} kind="primary" busy=${busy} onClick=${repeat}>Scan again<//>`}
    <${Refusal} problem=${problem ?? refused} />`;
}

/** What the report says that a person should know, warnings first. */
function Figures({scan, report}) {
  const {summary} = scan;
  const {mesh, notes = []} = summary ?? {};
  if (!mesh) return html`<p class="quiet">The figures come with the report.</p>`;
  const own = report?.self_calibration;
  // Its own panel says more of it, and the age of a calibration by the scan itself is none.
  const calibration = own ? null : report?.calibration;
  const warnings = [...notes.filter((each) => !own || !each.startsWith("calibrated by this scan alone")), ...(report?.evidence.contradictions ?? [])];
  const inUnit = (words) => scan.unit === "mm" ? words : words?.replace(/(\d) mm\b/g, `$1 ${scan.unit}`);
  const age = calibration?.age_days;
  return html`
    ${warnings.length > 0 && html`<h3>Take note</h3><ul class="warning">${warnings.map((each) => html`<li>${inUnit(each)}</li>`)}</ul>`}
    <${Facts} of=${[
      ...figures(scan).map(([name, value, written]) => [name, value === undefined ? null : written(value, scan.unit)]),
      ["σ holds", inUnit(summary.mesh.sigma_holds)],
      ["Patterns", summary.identity],
      ["Limited to", limits(scan.plan?.reconstruction?.region)],
      ["Calibration", calibration && (calibration.solved_at ? `${age === null ? "age not known" : `${Number(age.toPrecision(2))} days old`}` : calibration.absent)],
      ["Its expected error", calibration?.expected_error_mm && length(calibration.expected_error_mm)],
      ["Against the known truth, rms within 1 mm", summary.truth && length(summary.truth.rms_mm)],
      ["Area beyond 1 mm of it", Number.isFinite(summary.truth?.gross_fraction) ? percent(summary.truth.gross_fraction) : null],
    ]} />
    <p><a href=${scan.links.files["report.json"]}>The whole report</a></p>`;
}

/** [name, value, how it is written] of the figures that two scans are compared by. */
function figures({summary}) {
  const {figures: of, sigma_mm: sigma, covers_of_decoded: covered} = summary.mesh;
  return [
    ["Triangles", of.triangles, count], ["Vertices", of.vertices, count], ["Area", of.area_mm2, (mm2, unit) => `${count(Math.round(mm2))} ${unit === "mm" ? "mm²" : `(${unit})²`}`],
    ["σ, median", sigma.p50, length], ["σ, 95 % are below", sigma.p95, length], ["Decoded pixels that the mesh covers", covered ?? undefined, percent],
  ];
}

function Compare({scan, chosen}) {
  const [list, problem] = useValue("/scan?limit=50");
  const [id, setId] = useState("");
  const possible = (list?.scans ?? []).filter((each) => each.id !== scan.id && each.unit === scan.unit && each.triangles !== null && OVER.includes(each.state));
  const [other] = useValue(id ? `/scan/${id}` : null);
  useEffect(() => chosen(id ? other : null), [id, other]);
  const rows = other?.summary?.mesh && scan.summary?.mesh ? figures(scan).map((row, at) => [...row, figures(other)[at][1]]) : [];
  return html`<${Refusal} problem=${problem?.status ? problem : null} />
    ${list && possible.length === 0 ? html`<p class="quiet">There is no other scan with a mesh yet.</p>` : html`
      <label>with <select value=${id} onChange=${(event) => setId(event.target.value)}>
        <option value="">no other scan</option>
        ${possible.map((each) => html`<option value=${each.id}>${each.label ?? "Scan"}, ${moment(each.created_at)}</option>`)}
      </select></label>`}
    ${rows.length > 0 && html`<div class="wide"><table><thead><tr><th>Figure</th><th>This scan</th><th>The other</th><th>Difference</th></tr></thead>
      <tbody>${rows.map(([name, mine, written, theirs]) => html`<tr><th scope="row">${name}</th><td>${mine === undefined ? "–" : written(mine, scan.unit)}</td>
        <td>${theirs === undefined ? "–" : written(theirs, scan.unit)}</td><td>${mine === undefined || theirs === undefined ? "–" : `${theirs < mine ? "−" : "+"}${written(Math.abs(theirs - mine), scan.unit)}`}</td></tr>`)}</tbody></table></div>
      <p class="quiet">Each is shown where its own calibration puts it. The colours "Deviation" show how far this mesh is from the other one.</p>`}`;
}
