// Devices: the rig as it is and as it is set, what else is plugged in, what examinations found, and who is logged in.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Action, Badge, Facts, Progress, Refusal, moment, percent} from "./ui.js";

const short = (value) => Number(value.toPrecision(3));
const duration = (seconds) => (seconds < 1e-3 ? `${short(1e6 * seconds)}\u00a0µs` : seconds < 1 ? `${short(1e3 * seconds)}\u00a0ms` : `${short(seconds)}\u00a0s`);
const between = ([least, most], words) => (least === most ? `${words(least)} only` : `${words(least)} to ${words(most)}`);

export function DevicesScreen({rig, may}) {
  return html`<section aria-label="This rig"><${ThisRig} rig=${rig} /></section>
    <section aria-label="Plugged in"><${PluggedIn} rig=${rig} /></section>
    <section aria-label="Examinations"><${Examinations} rig=${rig} may=${may} /></section>
    <section aria-label="You"><${You} may=${may} /></section>`;
}

function ThisRig({rig}) {
  if (!rig) return null;
  const {cameras, projector} = rig;
  return html`<h2>This rig</h2>
    ${rig.error && html`<${Refusal} problem=${{document: {title: "The rig is not open"}, message: rig.error}}><p>The next scan tries again.</p><//>`}
    ${!rig.open && !rig.error && html`<p role="status">The rig is being opened …</p>`}
    <ul class="cards">${cameras.map((camera) => html`<li class="box" key=${camera.name}><${Camera} camera=${camera} /></li>`)}
      ${projector && html`<li class="box"><h3>Projector${projector.name === "projector" ? "" : ` ${projector.name}`}</h3><${Facts} of=${[
        ["Model", projector.model],
        ["Serial number", projector.serial || null],
        ["Pixels", projector.size_px.join(" × ")],
        ["Sequences", projector.plays ? "plays them by itself" : "shows one pattern at a time"],
        ["From command to light", duration(projector.latency_s)],
      ]} /></li>`}</ul>`;
}

function Camera({camera}) {
  const set = camera.exposure_s !== null;
  return html`<h3>Camera ${camera.name}</h3>
    <${Facts} of=${[
      ["Exposure in use", set ? duration(camera.exposure_s) : "not set yet"],
      ["Gain in use", set ? short(camera.gain) : "not set yet"],
      ["Exposures it takes", between(camera.exposure_range_s, duration)],
      ["Gains it takes", between(camera.gain_range, short)],
      ["Model", camera.model],
      ["Serial number", camera.serial || null],
      ["Pixels", `${camera.size_px.join(" × ")}, ${camera.bit_depth} bits`],
      ["Triggered by", camera.triggers.join(", ")],
    ]} />
    ${!set && html`<p class="quiet">It is set by the first scan, or live picture.</p>`}
    ${camera.notes.length > 0 && html`<ul>${camera.notes.map((note) => html`<li class="warning">${note}</li>`)}</ul>`}`;
}

function PluggedIn({rig}) {
  const [found, problem, again] = useValue("/device");
  const [look, busy] = useAction(again);
  // A rig file may name a device in several ways; what has the serial number of the rig's device is that one.
  const serials = [...(rig?.cameras ?? []), rig?.projector].map((each) => each?.serial).filter((serial) => serial?.length >= 4);
  const inRig = ({device, label}) => serials.some((serial) => device.includes(serial) || label.includes(serial));
  const broken = found?.drivers.filter((driver) => driver.fault) ?? [];
  return html`<h2>Plugged in</h2>
    <${Action} busy=${busy || (!found && !problem)} onClick=${look}>Look again<//>
    ${!found && !problem && html`<p role="status">Every driver is asked what it sees …</p>`}
    <${Refusal} problem=${problem} />
    ${found?.devices.length === 0 && html`<p>No device is plugged in that an installed driver can find. Check cable and power. A rendered rig needs none.</p>`}
    ${found?.devices.length > 0 && html`<div class="wide" tabindex="0" role="region" aria-label="Devices that are plugged in"><table class="broad">
      <thead><tr><th scope="col">Driver</th><th scope="col">Device, as a rig file names it</th><th scope="col">What it is</th></tr></thead>
      <tbody>${found.devices.map((each) => html`<tr><td>${each.driver}</td><td><code>${each.device}</code></td><td>${each.label} ${inRig(each) && html`<${Badge} kind="good">in this rig<//>`}</td></tr>`)}</tbody>
    </table></div>`}
    ${found?.missing.length > 0 && html`<h3>More devices can be used after</h3>
      <ul>${found.missing.map(({driver, install}) => html`<li>${driver}: <code>${install}</code></li>`)}</ul>`}
    ${(broken.length > 0 || found?.faults.length > 0) && html`<h3>Drivers that do not work</h3>
      <ul>${[...new Set([...broken.map((driver) => driver.fault), ...found.faults])].map((fault) => html`<li class="warning">${fault}</li>`)}</ul>`}
    ${found && html`<details><summary>Installed drivers</summary>
      <p>${found.drivers.filter(({kind}) => kind !== "finder").map(({kind, name}) => `${name} (${kind})`).join(", ")}</p>
      ${found.elsewhere.map(({message}) => html`<p class="quiet">${message}</p>`)}</details>`}`;
}

function Examinations({rig, may}) {
  const [last, problem, again] = useValue("/rig/examinations", 10);
  if (!last) return html`<${Refusal} problem=${problem?.status ? problem : null} />`;
  const given = {rig, may, ended: again};
  return html`<div class="halves">
    <div class="box"><h2>Doctor</h2>
      ${last.doctor ? html`<${Doctor} ...${last.doctor} />` : html`<p>Not examined yet.</p>`}
      <${Examine} kind="doctor" ...${given}>It looks for faults of light, timing, focus and flicker. Put a light, still object before the rig.<//></div>
    <div class="box"><h2>Conformance</h2>
      ${last.conformance ? html`<${Conformance} ...${last.conformance} />` : html`<p>Not examined yet.</p>`}
      <${Examine} kind="conformance" ...${given}>It checks that the drivers keep what they promise: the rig is closed and opened many times.<//></div>
  </div>`;
}

/** Starts an examination, and shows it while it runs, also one that somebody else started. */
function Examine({kind, rig, may, ended, children}) {
  const [job, setJob] = useState(null);
  const other = new RegExp(`^${kind} (.+)$`).exec(rig?.holder ?? "")?.[1];
  useEffect(() => {
    if (other) setJob(other);
  }, [other]);
  const [start, busy, refused] = useAction(async () => setJob((await ask("POST", `/rig/${kind}`, {body: {if_busy: "queue"}, headers: once()})).id));
  return html`<p class="quiet">${children}</p>
    ${job ? html`<${Examining} key=${job} here=${`/rig/job/${job}`} may=${may} ended=${() => (setJob(null), ended())} />`
      : html`<${Action} busy=${busy} disabled=${!may("calibrate")} onClick=${start}>Examine now<//>`}
    <${Refusal} problem=${refused} />`;
}

function Examining({here, may, ended}) {
  const [at, setAt] = useState({stage: "waits for the rig", fraction: 0});
  const [failed, setFailed] = useState(null);
  useEffect(() => {
    const look = async () => {
      const body = await ask("GET", here);
      if (body.error) setFailed(body.error);
      else if (body.state === "succeeded") ended();
    };
    return follow(`${here}/events`, (kind, data) => {
      if (kind === "progress") setAt(data);
      if (kind === "state") look();
    }, look);
  }, [here]);
  const [cancel, busy, refused] = useAction(() => ask("POST", `${here}/cancel`));
  if (failed) return html`<${Refusal} problem=${{document: {title: "The examination ended early"}, message: failed.detail}}>
    <${Action} onClick=${ended}>Close<//><//>`;
  return html`<${Progress} label=${at.stage} fraction=${at.fraction} detail=${at.detail} />
    <${Action} busy=${busy} disabled=${!may("calibrate")} onClick=${cancel}>Cancel<//>
    <${Refusal} problem=${refused} />`;
}

const SEVERITIES = {fault: "bad", note: "warn", ok: "good"};

function Doctor({at, found}) {
  const rows = (findings) => html`<ul class="findings">${findings.map((each) => html`<li>
    <${Badge} kind=${SEVERITIES[each.severity]}>${each.severity}<//> <strong>${each.subject}</strong>: ${each.found}
    ${each.remedy && html`<p><strong>What to do:</strong> ${each.remedy}.</p>`}</li>`)}</ul>`;
  const matter = found.findings.filter((each) => each.severity !== "ok");
  const well = found.findings.filter((each) => each.severity === "ok");
  return html`<p class="quiet">${moment(at)}</p>
    ${matter.length === 0 ? html`<p><${Badge} kind="good">healthy<//> It found nothing wrong.</p>` : rows(matter)}
    <details><summary>What is well: ${well.length}</summary>${rows(well)}</details>`;
}

function Conformance({at, found}) {
  const wrong = found.checks.filter((check) => ["failed", "not run"].includes(check.outcome));
  return html`<p class=${`verdict ${wrong.length ? "bad" : "good"}`}>${Math.floor(100 * found.score)} %</p>
    <p>${found.passed} of ${found.applicable} checks that apply passed. <span class="quiet">${moment(at)}</span></p>
    ${found.stopped && html`<p class="warning">It ended early: ${found.stopped}</p>`}
    <ul class="findings">${wrong.map((check) => html`<li><${Badge} kind="bad">${check.outcome}<//> <strong>${check.title}</strong>
      ${check.failure && html`<${Facts} of=${[["Where", check.failure.where || null], ["Asked", check.failure.asked], ["Found", check.failure.found], ["What to do", check.failure.do]]} />`}
      ${check.reason && html`<p>${check.reason}</p>`}</li>`)}</ul>`;
}

function You({may}) {
  const [session] = useValue("/session");
  const [audit, problem] = useValue(may("administer") ? "/audit?limit=10" : null, 10);
  if (!session) return null;
  return html`<h2>You</h2>
    <p>${session.name === "anyone" ? "This service asks nobody for a key." : html`Logged in as <strong>${session.name}</strong>, ${session.expires_at ? `until ${new Date(session.expires_at).toLocaleString("en-GB", {dateStyle: "medium", timeStyle: "short"})}` : "without end"}.`}
      ${" "}You may ${session.scopes.join(", ")}.</p>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${audit && html`<div class="wide" tabindex="0" role="region" aria-label="Who did what last"><table class="broad"><caption>Who did what last</caption>
      <thead><tr>${["When", "Who", "From", "What", "Answer"].map((head) => html`<th scope="col">${head}</th>`)}</tr></thead>
      <tbody>${audit.entries.map((each) => html`<tr><td>${moment(each.at)}</td><td>${each.who}</td><td>${each.address}</td><td>${each.method} ${each.path}</td><td>${each.status}</td></tr>`)}</tbody>
    </table></div>`}`;
}
