// The acceptance test: begun with the artefacts' certificates, measured position by position, decided, and its report.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {ask, once, useAction, useValue} from "./service.js";
import {Action, Badge, Choice, Confirm, Facts, Field, Progress, Refusal, length, moment} from "./ui.js";

const STATES = {open: ["busy", "Open"], measuring: ["busy", "Measuring"], interrupted: ["warn", "Interrupted"], finished: ["good", "Finished"], cancelled: ["warn", "Stopped"]};
const DECISIONS = {passes: ["good", "Passes"], fails: ["bad", "Fails"], undecided: ["warn", "Undecided"]};
const QUANTITIES = {PF: "Form of the sphere", PS: "Size of the sphere", SD: "Distance of the spheres", F: "Flatness"};
const going = ({state}) => ["open", "measuring", "interrupted"].includes(state);

export function Acceptance({rig, may}) {
  const [list, problem, again] = useValue("/acceptance?limit=10", 5);
  const able = may("calibrate");
  const tests = list?.tests ?? [];
  const current = tests.find(going);
  return html`<${Refusal} problem=${problem?.status ? problem : null} />
    ${current ? html`<${Current} key=${current.id} id=${current.id} rig=${rig} able=${able} changed=${again} />` : list && html`<${Begin} rig=${rig} able=${able} begun=${again} />`}
    ${tests.some((test) => !going(test)) && html`<h4>Earlier tests</h4><ul class="findings">${tests.filter((test) => !going(test)).map((test) => html`<${Earlier} key=${test.id} test=${test} able=${able} changed=${again} />`)}</ul>`}`;
}

const CERTIFIED = [
  ["sphere", "Sphere: diameter, mm"], ["sphereU", "Sphere: uncertainty (k = 2), mm"],
  ["bar", "Ball bar: distance, mm"], ["barU", "Ball bar: uncertainty (k = 2), mm"],
  ["planeA", "Plane: length, mm"], ["planeB", "Plane: width, mm"],
  ["sphereForm", "Sphere: out of round by, mm"], ["planeForm", "Plane: out of flat by, mm"],
];

/** The artefacts are those of a certificate, or, of a rendered rig, exact. What was typed last is there again. */
function Begin({rig, able, begun}) {
  const rendered = rig?.cameras.some(({model}) => model.startsWith("rendered")) ?? false;
  const [exact, setExact] = useState(null);
  const made = exact ?? rendered;
  const [typed, setTyped] = useState(() => JSON.parse(localStorage.getItem("artefacts") ?? "{}"));
  const [start, busy, refused] = useAction(async () => {
    const number = (name) => Number(typed[name]);
    const artefacts = made ? null : {
      sphere: {value_mm: number("sphere"), uncertainty_mm: number("sphereU")}, bar: {value_mm: number("bar"), uncertainty_mm: number("barU")},
      plane_mm: [number("planeA"), number("planeB")], sphere_form_mm: number("sphereForm"), plane_form_mm: number("planeForm"), certificate: typed.certificate ?? "",
    };
    localStorage.setItem("artefacts", JSON.stringify(typed));
    await ask("POST", "/acceptance", {body: {...(artefacts && {artefacts})}, headers: once()});
    await begun();
  });
  const change = (name) => (value) => setTyped((before) => ({...before, [name]: value}));
  const missing = !made && CERTIFIED.some(([name]) => !typed[name]);
  const why = !able ? "Your key may not test the rig." : rig?.calibrated === false ? html`The rig is not calibrated. <a href="#/calibrate">Calibrate it first</a>.` : missing ? "Fill in what the certificates say." : null;
  return html`<${Choice} label="Artefacts" value=${made} options=${[[false, "With certificates"], [true, "Exact, of a rendered rig"]]} chosen=${setExact} />
    ${!made && html`<div class="row numbers">${CERTIFIED.map(([name, label]) => html`<${Field} key=${name} label=${label} value=${typed[name] ?? ""} change=${change(name)} />`)}
      <${Field} label="Certificate" type="text" value=${typed.certificate ?? ""} change=${change("certificate")} maxlength="200" /></div>`}
    <div class="row"><${Action} busy=${busy} disabled=${Boolean(why)} onClick=${start}>Begin a test<//><span class="quiet">${why}</span></div>
    <${Refusal} problem=${refused} />`;
}

/** A test that is under way: where to put which artefact, and what was measured. */
function Current({id, rig, able, changed}) {
  const [test, problem, again] = useValue(`/acceptance/${id}`, 2);
  const [asking, setAsking] = useState(false);
  const [measure, busy, refused] = useAction(async (scripted) => {
    await ask("POST", `/acceptance/${id}/position`, {body: {scripted, if_busy: "queue"}, headers: once()});
    await again();
  });
  const [stop, , unstopped] = useAction(() => ask("POST", `/acceptance/${id}/cancel`).then(() => (setAsking(false), changed())));
  useEffect(() => {
    if (test && !going(test)) changed();
  }, [test?.state]);
  if (!test) return html`<${Refusal} problem=${problem?.status ? problem : null} />`;
  const measuring = test.state === "measuring";
  const at = test.positions.findIndex(({name}) => name === test.next?.name) + 1;
  const byItself = test.positions.every(({name}) => rig?.positions.includes(name));
  return html`
    ${measuring && test.progress ? html`<${Progress} label=${test.progress.stage} fraction=${test.captures_done / test.captures} detail=${test.progress.detail} />`
      : test.next && html`<p class="quiet">Position ${at} of ${test.positions.length}</p><p class="why"><strong>${test.next.words}</strong></p>`}
    ${test.error && html`<${Refusal} problem=${{document: {title: "The last position was not measured"}, message: test.error.detail}} />`}
    <div class="row">${!measuring && html`<${Action} kind="primary" busy=${busy} disabled=${!able} onClick=${() => measure(false)}>It stands there: measure<//>`}
      ${!measuring && byItself && html`<${Action} busy=${busy} disabled=${!able} onClick=${() => measure(true)}>Measure all by the positioner<//>`}
      ${!asking && html`<${Action} disabled=${!able} onClick=${() => setAsking(true)}>End the test<//>`}</div>
    ${asking && html`<${Confirm} question="End this test without a decision?" yes="End it" onYes=${stop} onNo=${() => setAsking(false)} />`}
    <${Refusal} problem=${refused ?? unstopped} />
    <${Measured} test=${test} />`;
}

/** The largest error so far of each quantity, beside its limit. */
function worst(readings) {
  const most = {};
  for (const {errors_mm: errors} of readings)
    for (const [name, mm] of Object.entries(errors)) if (!(Math.abs(mm) <= Math.abs(most[name] ?? 0))) most[name] = mm;
  return most;
}

function Measured({test}) {
  const most = worst(test.readings);
  return html`<${Facts} of=${[["Captures", `${test.captures_done} of ${test.captures}`], ...Object.entries(test.limits_mm).map(([name, limit]) => [`${QUANTITIES[name]}, largest error`, `${most[name] === undefined ? "not measured yet" : length(most[name])} (limit ${length(limit)})`])]} />`;
}

function Earlier({test, able, changed}) {
  const [sure, setSure] = useState(false);
  const [remove, , problem] = useAction(() => ask("DELETE", `/acceptance/${test.id}`).then(changed));
  const [kind, word] = DECISIONS[test.decision] ?? STATES[test.state];
  return html`<li><div class="between"><span><${Badge} kind=${kind}>${word}<//> ${moment(test.created_at)}</span>
      <span class="row">${test.files["report.html"] && html`<a href=${test.files["report.html"]} target="_blank" rel="noopener">Report</a>`}
        ${able && !sure && html`<${Action} kind="plain" onClick=${() => setSure(true)}>Delete<//>`}</span></div>
    ${sure && html`<${Confirm} question="Delete this test with its report?" yes="Delete it" onYes=${remove} onNo=${() => setSure(false)} />`}
    <${Refusal} problem=${problem} /></li>`;
}
