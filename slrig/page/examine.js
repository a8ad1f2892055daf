// Tests of the rig: what each is for, how long it takes and what it needs; run, watched and read.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {Acceptance} from "./accept.js";
import {Axis} from "./axis.js";
import {Proposed} from "./rigfile.js";
import {Running} from "./running.js";
import {ask, once, useAction, useValue} from "./service.js";
import {Action, Badge, Facts, Refusal, begun, duration, moment} from "./ui.js";

const SEVERITIES = {fault: ["bad", "Fault"], note: ["warn", "Note"], ok: ["good", "Good"]};
const OUTCOMES = {failed: "Failed", "not run": "Not run"};
const STEADY = 0.02;

export function Tests(change) {
  const {rig, may, changed} = change;
  const [last, problem, again] = useValue("/rig/examinations", 10);
  const given = {rig, may, ended: () => Promise.all([again(), changed()])};
  return html`<h2>Tests of the rig</h2>
    <${Refusal} problem=${problem?.status ? problem : null} />
    <div class="halves">
      <${Card} title="Doctor" what="Finds faults of light, timing, focus and flicker, says what to do, and proposes exposures and lines for the rig file."
        takes="one to three minutes" needs="a light, still object in front of the rig">
        <${Examine} kind="doctor" ...${given} />
        ${last?.doctor ? html`<${Doctor} ...${last.doctor} /><${Proposed} kind="doctor" ...${change} />` : last && html`<p class="quiet">Not examined yet.</p>`}<//>
      <${Card} title="Latency" what="Measures how late the projector's light comes, so that no frame shows two patterns."
        takes="less than a minute" needs="something light in front of the rig that keeps still">
        <${Examine} kind="latency" ...${given} />
        ${last?.latency ? html`<${Latency} ...${last.latency} /><${Proposed} kind="latency" ...${change} />` : last && html`<p class="quiet">Not measured yet.</p>`}<//>
      <${Card} title="Conformance" what="Checks that the drivers keep what slrig relies on. A defect found here is one of a driver or a device, not of your setup."
        takes="a few minutes; the rig is closed and opened many times" needs="nothing; it may look at anything">
        <${Examine} kind="conformance" ...${given} />
        ${last?.conformance ? html`<${Conformance} ...${last.conformance} />` : last && html`<p class="quiet">Not checked yet.</p>`}<//>
      <${Card} title="Acceptance test" what="Measures certified artefacts all over the working volume and decides whether the rig keeps its limits, in the manner of VDI/VDE 2634 part 2."
        takes="about half an hour by hand: 23 positions" needs="a calibration, and a sphere, a ball bar and a plane with certificates">
        <${Acceptance} rig=${rig} may=${may} /><//>
      ${rig?.turntable && html`<${Card} title="Turntable axis" what="Measures the axis about which the turntable turns. Models of several views stand on it."
        takes="about a minute: six shots" needs="a calibration, and the calibration board upright on the turntable">
        <${Axis} rig=${rig} may=${may} /><//>`}
    </div>`;
}

function Card({title, what, takes, needs, children}) {
  return html`<section class="box" aria-label=${title}><h3>${title}</h3><p>${what}</p>
    <p class="quiet"><strong>Takes</strong> ${takes}. <strong>Needs</strong> ${needs}.</p>${children}</section>`;
}

/** Starts an examination, and shows it while it runs, also one that somebody else started. */
function Examine({kind, rig, may, ended}) {
  const [job, setJob] = useState(null);
  const other = new RegExp(`^${kind} (.+)$`).exec(rig?.holder ?? "")?.[1];
  useEffect(() => {
    if (other) setJob(other);
  }, [other]);
  const [start, busy, refused] = useAction(async () => setJob((await ask("POST", `/rig/${kind}`, {body: {if_busy: "queue"}, headers: once()})).id));
  return html`${job ? html`<${Running} key=${job} here=${`/rig/job/${job}`} may=${may} ended=${async () => (await ended(), setJob(null))} />`
      : html`<div class="row"><${Action} busy=${busy} disabled=${!may("calibrate")} onClick=${start}>Examine now<//>
        ${!may("calibrate") && html`<span class="quiet">Your key may not examine the rig.</span>`}</div>`}
    <${Refusal} problem=${refused} />`;
}

const sentence = (text) => `${begun(text)}${/[.!?]$/.test(text) ? "" : "."}`;

function Findings({of}) {
  return html`<ul class="findings">${of.map((each) => html`<li>
    <p><${Badge} kind=${SEVERITIES[each.severity][0]}>${SEVERITIES[each.severity][1]}<//> <strong>${begun(each.subject)}</strong></p>
    <p>${sentence(each.found)}</p>
    ${each.remedy && html`<p><strong>What to do:</strong> ${sentence(each.remedy)}</p>`}</li>`)}</ul>`;
}

function Doctor({at, found}) {
  const matter = found.findings.filter((each) => each.severity !== "ok");
  const well = found.findings.filter((each) => each.severity === "ok");
  return html`<p class="quiet">Examined ${moment(at)}</p>
    ${matter.length === 0 ? html`<p><${Badge} kind="good">Healthy<//> It found nothing wrong.</p>` : html`<${Findings} of=${matter} />`}
    <details><summary>What is well: ${well.length}</summary><${Findings} of=${well} /></details>`;
}

function Latency({at, found}) {
  const {synchronisation: whole, cameras} = found;
  return html`<p class="quiet">Measured ${moment(at)}</p>
    <${Facts} of=${[["Light comes after the projector says so", `${duration(whole.latency_s)}, and up to ${duration(whole.latency_error_s)} more`]]} />
    ${Object.entries(cameras).map(([name, each]) => html`<h4>By camera ${name}</h4><${Facts} of=${[
      ["Mean, of the flashes", `${duration(each.latency_s)} ± ${duration(each.standard_error_s)}`], ["It varies by (σ)", duration(each.jitter_s)],
      ["To white, to black", each.rise_s === null || each.fall_s === null ? null : `${duration(each.rise_s)}, ${duration(each.fall_s)}`],
      ["Shutter", each.rolling ? `rolling, ${duration(each.skew_s)} from the first row to the last` : each.scanned ? "the projector builds its picture row by row" : "global"],
      ["Flashes used", `${each.flashes_used} of ${each.flashes}${each.late ? `, ${each.late} came late` : ""}`],
    ]} />${each.flicker > STEADY && html`<p class="warning">Steady white flickers. Make the exposure a multiple of the projector's refresh period.</p>`}`)}`;
}

function Conformance({at, found}) {
  const wrong = found.checks.filter((check) => OUTCOMES[check.outcome]);
  return html`<p class=${`verdict ${wrong.length ? "bad" : "good"}`}>${Math.floor(100 * found.score)} %</p>
    <p>${found.passed} of ${found.applicable} checks that apply passed. <span class="quiet">${moment(at)}</span></p>
    ${found.stopped && html`<p class="warning">It ended early: ${found.stopped}</p>`}
    <ul class="findings">${wrong.map((check) => html`<li><${Badge} kind="bad">${OUTCOMES[check.outcome]}<//> <strong>${check.title}</strong>
      ${check.failure && html`<${Facts} of=${[["Where", check.failure.where || null], ["Expected", check.failure.asked], ["Found", check.failure.found], ["What to do", check.failure.do]]} />`}
      ${check.reason && html`<p>${check.reason}</p>`}</li>`)}</ul>`;
}
