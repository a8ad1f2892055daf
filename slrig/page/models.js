// Models: scans of one object from several sides, shot on a turntable or by hand, or chosen, and the one mesh that is made of them.
import {Downloads} from "./downloads.js";
import {Keeping} from "./keeping.js";
import {Live} from "./live.js";
import {Mesh, loadDrawing} from "./mesh.js";
import {NameHeading} from "./names.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Action, Choice, Facts, Field, JobBadge, Progress, Refusal, count, length, moment, percent} from "./ui.js";
import {html, useEffect, useState} from "./vendor/preact-htm.js";

const MODEL = "model.ply";
const USUAL_VIEWS = 8;
const over = (model) => ["succeeded", "failed", "cancelled", "interrupted"].includes(model.state);

export function ModelsScreen({rig, may, place}) {
  return place.length ? html`<${Back} /><${One} key=${place[0]} id=${place[0]} rig=${rig} may=${may} />` : html`<${All} rig=${rig} may=${may} />`;
}

const Back = () => html`<p><a href="#/models">All models</a></p>`;

function All({rig, may}) {
  const [list, problem] = useValue("/model?limit=24", 5);
  const models = list?.models ?? [];
  return html`
    ${may("scan") && html`<div class="two"><${Shoot} rig=${rig} /><${Join} rig=${rig} /></div>`}
    <section aria-label="Models"><h2>Models</h2>
      <${Refusal} problem=${problem?.status ? problem : null} />
      ${list && models.length === 0 && html`<p class="quiet">None yet. Turn an object before the rig, and shoot it from all sides.</p>`}
      <ul class="cards">${models.map((model) => html`<li><a class="card" href=${`#/models/${model.id}`}>
        ${model.links.picture ? html`<img src=${model.links.picture} alt="" loading="lazy" />` : html`<span class="none" aria-hidden="true">no picture</span>`}
        <span class="between"><span>${model.label ?? moment(model.created_at)}</span><${JobBadge} state=${model.state} /></span>
        ${model.triangles !== null && html`<span class="quiet">${model.views} views, ${count(model.triangles)} triangles, σ ${length(model.sigma_mm)}</span>`}
        ${!over(model) && html`<span class="quiet">${model.progress.detail || model.progress.stage}</span>`}
        ${model.error && html`<span class="quiet clip">${model.error.detail}</span>`}
      </a></li>`)}</ul>
    </section>`;
}

const shown = (model) => {
  location.hash = `#/models/${model.id}`;
};

const WAYS = [["turntable", "By the turntable's axis"], ["unknown", "By their shape"], ["markers", "By printed markers"]];
const HOW = {
  turntable: "The axis and the angles say where each view belongs.",
  unknown: "The views are matched by what they see. It takes an object that is not symmetric, and views that overlap well.",
  markers: "Markers of the dictionary DICT_5X5_250 turn with the object, several in each view.",
};

/** How views are put together: the axis, where it is known, or what the person chooses. */
function useWay() {
  const [table] = useValue("/rig/turntable", 10);
  const [chosen, setChosen] = useState(null);
  const known = table ? table.state !== "unknown" : null;
  return {known, way: chosen ?? (known === false ? "unknown" : "turntable"), choose: setChosen, moved: table?.state === "moved"};
}

function Way({known, way, choose, moved, turns}) {
  const axis = turns ? html`<a href="#/devices">Measure the turntable's axis</a> once, under Devices.` : html`This rig has no turntable whose axis could be measured.`;
  return html`<${Choice} label="How the views are put together" value=${way} options=${WAYS} chosen=${choose} />
    <p class="quiet">${HOW[way]}${known === false && way !== "turntable" ? html` No axis is known. ${turns && axis}` : ""}</p>
    ${known === false && way === "turntable" && html`<p class="warning">No axis is known here. ${axis}</p>`}
    ${moved && way === "turntable" && html`<p class="warning">The last model turned about another axis. ${axis}</p>`}`;
}

function Shoot({rig}) {
  const [views, setViews] = useState(String(USUAL_VIEWS));
  const turns = rig?.turntable === true;
  const [hand, setHand] = useState(false);
  const given = useWay();
  const manual = hand || !turns;
  const [start, busy, refused] = useAction(async () => shown(await ask("POST", "/model/shoot", {body: {views: Number(views), manual, poses: given.way, if_busy: "queue"}, headers: once()})));
  const why = rig?.error ? "The rig is not open." : rig?.calibrated === false ? html`The rig is not calibrated. <a href="#/calibrate">Calibrate it first</a>.` : null;
  const ready = Number(views) >= 2 && given.known !== null && !why && !(given.way === "turntable" && given.known === false);
  return html`<section aria-label="Shoot from all sides"><h2>Shoot from all sides</h2>
    <div class="row"><${Field} label="Views, evenly around" value=${views} change=${setViews} min="2" max="72" step="1" />
      ${turns ? html`<label class="tick"><input type="checkbox" checked=${hand} onChange=${(event) => setHand(event.target.checked)} /> I turn the object by hand</label>` : ""}</div>
    ${rig && !turns && html`<p class="quiet">This rig has no turntable. You turn the object by hand; this page says when, and by how much.</p>`}
    <${Way} ...${given} turns=${turns} />
    <div class="row"><${Action} kind="primary" busy=${busy} disabled=${!ready} onClick=${start}>Shoot the views<//><span class="quiet">${why}</span></div>
    <${Refused} problem=${refused} />
  </section>`;
}

/** Scans that there are, chosen in the order in which the object was turned. */
function Join({rig}) {
  const [list] = useValue("/scan?limit=50", 10);
  const [chosen, setChosen] = useState([]);
  const given = useWay();
  const scans = (list?.scans ?? []).filter(({state}) => state === "succeeded");
  const toggle = (id) => setChosen((before) => before.includes(id) ? before.filter((each) => each !== id) : [...before, id]);
  const [start, busy, refused] = useAction(async () => shown(await ask("POST", "/model", {body: {scans: chosen, poses: given.way}, headers: once()})));
  return html`<section aria-label="Join scans"><h2>Join existing scans</h2>
    ${list && scans.length < 2 ? html`<p class="quiet">Make at least two scans of the object from different sides.</p>` : html`
      <div class="wide pick" tabindex="0" role="region" aria-label="Scans to choose from"><table><thead><tr><th scope="col">Scan</th><th scope="col">Turntable</th><th scope="col">In the model</th></tr></thead>
        <tbody>${scans.map((scan) => html`<tr><th scope="row"><a href=${`#/scan/${scan.id}`}>${scan.label ?? moment(scan.created_at)}</a></th>
          <td>${scan.turn_deg === null ? "–" : degrees(scan.turn_deg)}</td>
          <td><label class="tick"><input type="checkbox" checked=${chosen.includes(scan.id)} onChange=${() => toggle(scan.id)} /> ${chosen.includes(scan.id) ? `View ${chosen.indexOf(scan.id) + 1}` : "Take it"}</label></td></tr>`)}</tbody></table></div>
      <${Way} ...${given} turns=${rig?.turntable} />
      <${Action} busy=${busy} disabled=${chosen.length < 2} onClick=${start}>${chosen.length < 2 ? "Choose two scans or more" : `Make one model of ${chosen.length}`}<//>
      <${Refused} problem=${refused} />`}
  </section>`;
}

const degrees = (value) => `${Number(value.toFixed(2))}°`;
const REFUSALS = {
  config: "No model can be made so", "stage-refused": "The views do not stand on the turntable's axis", "registration-refused": "The views do not fit together", "views-failed": "Too few views succeeded",
  "rig-busy": "The rig is in use", "unsupported-by-device": "The rig cannot do that", "scan-cancelled": "The model was stopped", calibration: "The rig is not calibrated", storage: "There is no room for it",
};

/** A refusal under a title for people. */
function Refused({problem, children}) {
  if (!problem) return null;
  const code = (problem.document?.type ?? "").split("/").at(-1);
  return html`<${Refusal} problem=${{...problem, message: problem.message ?? problem.document.detail, document: {...problem.document, title: REFUSALS[code] ?? problem.document?.title ?? "There is no model"}}}>${children}<//>`;
}

function One({id, rig, may}) {
  const [model, problem, again] = useValue(`/model/${encodeURIComponent(id)}`, 5);
  useEffect(() => {
    loadDrawing().catch(() => {});
  }, []);
  if (problem?.status === 404 || problem?.status === 422)
    return html`<${Refusal} problem=${{document: {title: "This model is not there"}, message: "It was deleted, or the address is not right."}} />`;
  if (!model) return html`<${Refusal} problem=${problem} />${!problem && html`<p class="wait">Asking for the model …</p>`}`;
  return html`<${Whole} model=${model} rig=${rig} again=${again} may=${may} />`;
}

function Whole({model, rig, again, may}) {
  const views = useViews(model);
  const {files} = model.links;
  const done = over(model);
  const [told, setTold] = useState(model.progress);
  const [report, refused] = useValue(files["report.json"] ?? null);
  useEffect(() => done ? undefined : follow(model.links.events, (kind, data) => {
    if (kind === "progress") setTold(data);
    again();
  }, again), [done]);
  const drawn = {id: model.id, links: model.links, merged: true, plan: {}, summary: {mesh: {sigma_mm: report?.model.sigma_ends_mm}}};
  return html`
    <div class="between"><${NameHeading} job=${model} kind="Model" may=${may("scan")} again=${again}><${JobBadge} state=${model.state} /><//>
      ${Object.keys(files).length > 0 && html`<${Downloads} files=${files} />`}</div>
    <div class="two">
      <section aria-label="Model">
        ${!done && html`<div class="box"><${Progress} label=${told.stage} fraction=${told.fraction} detail=${told.detail} />
          </div>`}
        ${!done && model.plan.shoot?.manual && may("scan") && html`<${Hand} model=${model} rig=${rig} may=${may} told=${told} views=${views} again=${again} />`}
        ${files[MODEL] && html`<${Mesh} scan=${drawn} other=${null} report=${null} again=${null} />`}
        ${model.error && html`<${Refused} problem=${{document: model.error}}>${views.length > 0 && html`<p>Its views stay, and can be joined in another way: <a href="#/models">all models</a>.</p>`}<//>`}
        <${Views} views=${views} report=${report} poses=${files["poses.json"]} />
      </section>
      <section aria-label="Figures">
        <${Refusal} problem=${refused} />
        ${report && html`<${Figures} report=${report} path=${files["report.json"]} />`}
        ${may("scan") && html`<h3>Keep or delete</h3><${Keeping} job=${model} kind="model" over=${done} again=${again} />`}
      </section>
    </div>
    ${files["sides.png"] && html`<h3>From six sides</h3><div class="wide"><img src=${files["sides.png"]} alt="The model from six sides" /></div>`}
    ${report && html`<${Pairs} report=${report} views=${views} />`}`;
}

/** The scans of a model in their order, from new ones on while it is shot: of each view the last. */
function useViews(model) {
  const shot = model.plan.shoot !== null;
  const [series] = useValue(shot ? `/scan/series/${model.id}` : null, over(model) ? 0 : 2);
  const angles = model.plan.poses.angles_deg;
  if (!shot) return model.plan.scans.map((id, at) => ({id, number: at + 1, angle: angles?.[at] ?? null, state: "succeeded", files: null, error: null}));
  const newest = new Map();
  for (const scan of series?.scans ?? []) newest.set(scan.plan.series.number, {id: scan.id, number: scan.plan.series.number, angle: scan.plan.turn_deg, state: scan.state, files: scan.links.files, error: scan.error});
  return [...newest.values()].sort((one, other) => one.number - other.number);
}

/** How far a pose turns and shifts a view: [degrees, mm]. `pose`: 4 × 4. */
function motion(pose) {
  const trace = pose[0][0] + pose[1][1] + pose[2][2];
  return [(180 / Math.PI) * Math.acos(Math.min(1, Math.max(-1, (trace - 1) / 2))), Math.hypot(pose[0][3], pose[1][3], pose[2][3])];
}

function Views({views, report, poses}) {
  const [found] = useValue(poses ?? null);
  if (views.length === 0) return null;
  const placed = new Map((found?.views ?? []).map(({name, pose}) => [name, motion(pose)]));
  const sigma = new Map((report?.views ?? []).map(({name, sigma_mm: mm}) => [name, mm]));
  return html`<h3>Views</h3><ul class="cards">${views.map((view) => html`<${View} key=${view.number} view=${view} motion=${placed.get(view.id)} sigma=${sigma.get(view.id)} left=${report && !sigma.has(view.id)} />`)}</ul>`;
}

function View({view, motion: moved, sigma, left}) {
  const [scan] = useValue(view.files ? null : `/scan/${view.id}`);
  const files = view.files ?? scan?.links.files ?? {};
  const picture = files["thumbnail.png"] ?? files["preview.png"];
  return html`<li><a class="card" href=${`#/scan/${view.id}`}>
    ${picture ? html`<img src=${picture} alt="" loading="lazy" />` : html`<span class="none" aria-hidden="true">no picture</span>`}
    <span class="between"><span>View ${view.number}${view.angle === null ? "" : `, ${degrees(view.angle)}`}</span>${view.state !== "succeeded" && html`<${JobBadge} state=${view.state} />`}</span>
    ${sigma === 0 ? html`<span class="quiet">the model stands in its frame</span>` : sigma !== undefined && html`
      ${moved && html`<span class="quiet">turned ${moved[0].toFixed(2)}°, shifted ${length(moved[1])}</span>`}
      <span class="quiet">pose known to ${length(sigma)} (σ)</span>`}
    ${left && html`<span class="warning">not in the model</span>`}
    ${view.error && html`<span class="quiet clip">${view.error.detail}</span>`}
  </a></li>`;
}

/** A model that waits for somebody to turn its object: what to turn, and the last view over the live picture. */
function Hand({model, rig, may, told, views, again}) {
  const act = (path, body) => ask("POST", `${model.links.self}/${path}`, {body, headers: once()}).then(again);
  const [next, busy, refused] = useAction((more) => act("view", more));
  const [combine, combining, unmade] = useAction(() => act("combine"));
  const waits = told.stage === "turn";
  const last = views.at(-1);
  const good = views.filter(({state}) => state === "succeeded").length;
  const {views: all} = model.plan.shoot;
  const step = 360 / all;
  const failed = last && ["failed", "cancelled", "interrupted"].includes(last.state);
  const ghost = Object.fromEntries((rig?.cameras ?? []).map(({name}) => [name, last?.files[`rejected-${name}.png`]]));
  return html`<div class="box" aria-label="Turn the object" role="group">
    <p class="say" role="status">${!waits ? `View ${last?.number ?? 1} of ${all}: do not touch the object.` : failed ? `View ${last.number} failed: shoot it again.`
      : last?.number >= all ? "All views are there." : `Turn the object by ${degrees(step)}.`}</p>
    ${waits && failed && html`<p class="why">${last.error?.detail}</p>`}
    ${waits && !failed && last?.number < all && html`<p class="why">To ${degrees(last.number * step)} in all, the same way each time, about an upright axis. Then shoot view ${last.number + 1} of ${all}.</p>`}
    <div class="row">
      ${last?.number < all && html`<${Action} kind=${failed ? "" : "primary"} busy=${busy} disabled=${!waits} onClick=${() => next({if_busy: "queue"})}>I have turned it: next view<//>`}
      <${Action} kind=${failed ? "primary" : ""} busy=${busy} disabled=${!waits} onClick=${() => next({again: true, if_busy: "queue"})}>Shoot the last view again<//>
      <${Action} busy=${combining} disabled=${!waits || good < 2} onClick=${combine}>Make the model of ${good} ${good === 1 ? "view" : "views"}<//>
    </div>
    ${waits && good < 2 && html`<p class="quiet">A model takes two views or more.</p>`}
    <${Refused} problem=${refused ?? unmade} />
    ${waits && html`<${Live} rig=${rig} may=${may} ghost=${ghost} />
      ${Object.values(ghost).some(Boolean) && html`<p class="quiet">The last view lies over the live picture, grey and half-transparent: it shows how far the object was turned since.</p>`}`}
  </div>`;
}

function Figures({report, path}) {
  const {model, axis, views, free} = report;
  const once_seen = model.seen_by["1"] ?? 0;
  const warnings = [...(report.notes ?? []), ...new Set(free.map(({words, view}) => `${view}: ${words}`))];
  return html`
    ${warnings.length > 0 && html`<h3>Take note</h3><ul class="warning">${warnings.map((each) => html`<li>${each}</li>`)}</ul>`}
    <h3>Figures</h3>
    <${Facts} of=${[
      ["Views", views.length], ["Triangles", count(model.triangles)], ["Vertices", count(model.vertices)], ["Edges", length(model.voxel_mm)],
      ["σ, median", length(model.sigma_mm)], ["Neighbours err alike by", length(model.correlated_mm)], ["Seen by one view only", percent(once_seen)],
      ["The least known view, σ", length(Math.max(...views.map(({sigma_mm}) => sigma_mm)))],
      ["The turntable's angles, most off", axis && `${Math.max(...axis.turntable_error_deg.map(Math.abs)).toFixed(3)}°`],
    ]} />
    <p><a href=${path}>The whole report</a></p>`;
}

function Pairs({report, views}) {
  const named = new Map(views.map(({id, number}) => [id, number]));
  return html`<h3>How well the views agree</h3><div class="wide"><table>
    <thead><tr><th>Views</th><th>Overlap</th><th>Residual, rms</th><th>Over σ</th><th>Closure</th></tr></thead>
    <tbody>${report.pairs.map((pair) => html`<tr><th scope="row">${named.get(pair.first) ?? pair.first} and ${named.get(pair.second) ?? pair.second}</th><td>${percent(pair.overlap)}</td><td>${length(pair.rms_mm)}</td>
      <td>${pair.rms_over_sigma.toFixed(2)}</td><td>${length(pair.closure_mm)}</td></tr>`)}</tbody></table></div>
    <p class="quiet">The closure is how far a pair alone would put its views from where all together do.</p>`;
}
