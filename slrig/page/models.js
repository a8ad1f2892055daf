// Models: scans of one object from several sides, shot on a turntable or by hand, or chosen, and the one mesh that is made of them.
import {Downloads} from "./downloads.js";
import {Mesh, loadDrawing} from "./mesh.js";
import {NameHeading} from "./names.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Action, Confirm, Facts, Field, JobBadge, Progress, Refusal, count, length, moment, percent} from "./ui.js";
import {html, useEffect, useState} from "./vendor/preact-htm.js";

const MODEL = "model.ply";
const USUAL_VIEWS = 8;
const over = (model) => ["succeeded", "failed", "cancelled", "interrupted"].includes(model.state);

export function ModelsScreen({rig, may, place}) {
  return place.length ? html`<${Back} /><${One} key=${place[0]} id=${place[0]} may=${may} />` : html`<${All} rig=${rig} may=${may} />`;
}

const Back = () => html`<p><a href="#/models">All models</a></p>`;

function All({rig, may}) {
  const [list, problem] = useValue("/model?limit=24", 5);
  const models = list?.models ?? [];
  return html`
    ${may("scan") && html`<div class="two"><${Shoot} rig=${rig} /><${Join} /></div>`}
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

function Shoot({rig}) {
  const [views, setViews] = useState(String(USUAL_VIEWS));
  const turns = rig?.turntable === true;
  const [hand, setHand] = useState(false);
  const manual = hand || !turns;
  const [start, busy, refused] = useAction(async () => shown(await ask("POST", "/model/shoot", {body: {views: Number(views), manual, if_busy: "queue"}, headers: once()})));
  return html`<section aria-label="Shoot from all sides"><h2>Shoot from all sides</h2>
    <div class="row"><${Field} label="Views, evenly around" value=${views} change=${setViews} min="2" step="1" />
      ${turns ? html`<label><input type="checkbox" checked=${hand} onChange=${(event) => setHand(event.target.checked)} /> I turn the object by hand</label>` : ""}</div>
    ${rig && !turns && html`<p class="quiet">This rig has no turntable. You turn the object by hand; this page says when, and by how much.</p>`}
    <${Action} kind="primary" busy=${busy} disabled=${!(Number(views) >= 2)} onClick=${start}>Shoot the views<//>
    <${Refusal} problem=${refused} />
  </section>`;
}

/** Scans that there are, chosen in the order in which the object was turned. */
function Join() {
  const [list] = useValue("/scan?limit=50", 10);
  const [chosen, setChosen] = useState([]);
  const scans = (list?.scans ?? []).filter(({state}) => state === "succeeded");
  const toggle = (id) => setChosen((before) => before.includes(id) ? before.filter((each) => each !== id) : [...before, id]);
  const [start, busy, refused] = useAction(async () => shown(await ask("POST", "/model", {body: {scans: chosen}, headers: once()})));
  return html`<section aria-label="Join scans"><h2>Join scans that there are</h2>
    ${list && scans.length < 2 ? html`<p class="quiet">It takes two scans that know the angle of their turntable.</p>` : html`
      <div class="wide pick"><table><thead><tr><th>Scan</th><th>Turntable</th><th>In the model</th></tr></thead>
        <tbody>${scans.map((scan) => html`<tr><th scope="row"><a href=${`#/scan/${scan.id}`}>${scan.label ?? moment(scan.created_at)}</a></th>
          <td>${scan.turn_deg === null ? "–" : `${Number(scan.turn_deg.toFixed(2))}°`}</td>
          <td><label><input type="checkbox" checked=${chosen.includes(scan.id)} onChange=${() => toggle(scan.id)} /> ${chosen.includes(scan.id) ? `view ${chosen.indexOf(scan.id) + 1}` : "no"}</label></td></tr>`)}</tbody></table></div>
      <${Action} busy=${busy} disabled=${chosen.length < 2} onClick=${start}>Make one model of ${chosen.length}<//>
      <${Refusal} problem=${refused} />`}
  </section>`;
}

function One({id, may}) {
  const [model, problem, again] = useValue(`/model/${encodeURIComponent(id)}`, 5);
  useEffect(() => {
    loadDrawing().catch(() => {});
  }, []);
  if (problem?.status === 404 || problem?.status === 422)
    return html`<${Refusal} problem=${{document: {title: "This model is not there"}, message: "It was deleted, or the address is not right."}} />`;
  if (!model) return html`<${Refusal} problem=${problem} />${!problem && html`<p class="wait">Asking for the model …</p>`}`;
  return html`<${Whole} model=${model} again=${again} may=${may} />`;
}

function Whole({model, again, may}) {
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
      <section aria-label="Mesh">
        ${!done && html`<div class="box"><${Progress} label=${told.stage} fraction=${told.fraction} detail=${told.detail} />
          ${may("scan") && told.stage === "turn" && html`<${Hand} model=${model} again=${again} />`}</div>`}
        ${files[MODEL] && html`<${Mesh} scan=${drawn} other=${null} report=${null} again=${null} />`}
        ${model.error && html`<${Refusal} problem=${{document: {title: "There is no model"}, message: model.error.detail}} />`}
      </section>
      <section aria-label="Figures">
        <${Refusal} problem=${refused} />
        ${report && html`<${Figures} report=${report} path=${files["report.json"]} />`}
        ${may("scan") && html`<${Keeping} model=${model} done=${done} again=${again} />`}
      </section>
    </div>
    ${files["sides.png"] && html`<h3>From six sides</h3><div class="wide"><img src=${files["sides.png"]} alt="The model from six sides" /></div>`}
    ${report && html`<${Pairs} report=${report} />`}`;
}

/** A model that waits for somebody to turn its object. */
function Hand({model, again}) {
  const act = (path, body) => ask("POST", `${model.links.self}/${path}`, {body, headers: once()}).then(again);
  const [next, busy, refused] = useAction((more) => act("view", more));
  const [combine, combining, unmade] = useAction(() => act("combine"));
  return html`<div class="row">
      <${Action} kind="primary" busy=${busy} onClick=${() => next({if_busy: "queue"})}>I have turned it: next view<//>
      <${Action} busy=${busy} onClick=${() => next({again: true, if_busy: "queue"})}>Shoot the last view again<//>
      <${Action} busy=${combining} onClick=${combine}>Make the model of what there is<//>
    </div><${Refusal} problem=${refused ?? unmade} />`;
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

function Pairs({report}) {
  return html`<h3>How well the views agree</h3><div class="wide"><table>
    <thead><tr><th>Views</th><th>Overlap</th><th>Residual, rms</th><th>Over σ</th><th>Closure</th></tr></thead>
    <tbody>${report.pairs.map((pair) => html`<tr><th scope="row">${pair.first}, ${pair.second}</th><td>${percent(pair.overlap)}</td><td>${length(pair.rms_mm)}</td>
      <td>${pair.rms_over_sigma.toFixed(2)}</td><td>${length(pair.closure_mm)}</td></tr>`)}</tbody></table></div>
    <p class="quiet">The closure is how far a pair alone would put its views from where all together do.</p>`;
}

function Keeping({model, done, again}) {
  const [sure, setSure] = useState(false);
  const [cancel, cancelling, uncancelled] = useAction(() => ask("POST", model.links.cancel).then(again));
  const [remove, , unremoved] = useAction(() => ask("DELETE", model.links.self).then(() => {
    location.hash = "#/models";
  }));
  return html`<h3>Keep or delete</h3>
    ${sure ? html`<${Confirm} question="Delete this model with all its files? Its scans stay." yes="Delete it" onYes=${remove} onNo=${() => setSure(false)} />`
    : done ? html`<${Action} onClick=${() => setSure(true)}>Delete<//>` : html`<${Action} busy=${cancelling} onClick=${cancel}>Stop it<//>`}
    <${Refusal} problem=${uncancelled ?? unremoved} />`;
}
