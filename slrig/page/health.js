// Health: whether the calibration still holds, a look at it now, and how it went over time; and what the clock does.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {BoardFields, PositionField, USUAL_BOARD, useBoard} from "./board.js";
import {Alerts} from "./alerts.js";
import {Schedules} from "./schedule.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Trend} from "./trend.js";
import {Action, Badge, Facts, Progress, Refusal, begun, bytes, duration, length, moment, number, percent} from "./ui.js";

const STATES = {good: ["good", "Good"], watch: ["warn", "Watch"], stale: ["bad", "Stale"], unknown: ["busy", "Not known"]};
const CHECKS = {records: "Records", disk: "Disk", rig: "Rig", reconstruction: "Reconstruction", threads: "Service"};

/** By how much what changed since the calibration moves a point of a scan, in mm; null where a verification does not say. */
const change = (verification) => verification?.drift_mm ?? null;
const written = (moved_mm) => moved_mm === 0 ? "None found" : length(moved_mm);
const thousandths = (value) => number(value, {decimals: 3});

export function HealthScreen({rig, may, place}) {
  const [health, problem, again] = useValue("/rig/health", 5);
  const [service] = useValue("/service", 15);
  const [history, unread, look] = useValue("/rig/health/history?limit=20");
  const newest = health?.latest?.id;
  useEffect(() => {
    if (newest) look();
  }, [newest]);
  return html`<h2 class="hidden">Health</h2>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${!health && !problem?.status && html`<p class="wait" role="status">Asking the service …</p>`}
    ${service && html`<${Attention} service=${service} />`}
    ${health && html`<div class="two">
      <section aria-label="State"><${State} health=${health} />
        <${Refusal} problem=${unread?.status ? unread : null} />
        ${history && html`<${Trends} records=${history.verifications} at=${health.thresholds} />`}</section>
      <section aria-label="Verify">${place[0] && html`<${Kept} key=${place[0]} id=${place[0]} may=${may} verified=${again} />`}<${Verify} rig=${rig} may=${may} verified=${again} /></section>
    </div>`}
    <div class="two even"><section aria-label="Schedule"><${Schedules} rig=${rig} may=${may} zone=${service?.time_zone} /></section>
      <section aria-label="Alerts"><${Alerts} may=${may} />${service && html`<${Service} service=${service} />`}</section></div>
    ${history?.verifications.length > 0 && html`<section aria-label="Records"><${Records} records=${history.verifications} /></section>`}`;
}

/** What keeps the rig from its work, with its cure, before everything else. */
function Attention({service}) {
  const wrong = Object.entries(service.checks).filter(([name, found]) => found !== "ok" && !service.pending.includes(name));
  const damaged = Object.entries(service.damaged);
  if (wrong.length + damaged.length === 0) return null;
  return html`<section class="refusal" role="alert" aria-label="To be looked at"><ul class="findings">
    ${wrong.map(([name, found]) => html`<li><${Badge} kind="bad">${CHECKS[name] ?? name}<//> ${found}</li>`)}
    ${damaged.map(([kind, amount]) => html`<li><${Badge} kind="warn">Damaged<//> ${amount} ${kind}${amount > 1 ? "s" : ""}: record or files are gone or were changed.
      <p><strong>What to do:</strong> Bring the files back from a backup, or delete ${amount > 1 ? "them" : "it"} where the others of its kind are listed.</p></li>`)}
  </ul></section>`;
}

/** The service itself: its disk and its version. */
function Service({service}) {
  const used = 1 - service.free_bytes / service.total_bytes;
  const full = service.free_bytes < service.spare_bytes;
  return html`<h2>Service</h2><div class="box">
    <div class="between"><span id="disk">Disk, ${percent(Math.round(100 * used) / 100)} used</span><span>${full && html`<${Badge} kind="bad">Full<//> `}${bytes(service.free_bytes)} free of ${bytes(service.total_bytes)}</span></div>
    <meter class="disk" aria-labelledby="disk" min="0" max="1" low="0.9" high="0.97" optimum="0" value=${used}></meter>
    <${Facts} of=${[
      ["Kept free", service.spare_bytes ? bytes(service.spare_bytes) : null], ["Version", service.version], ["Python", service.python], ["Time zone", service.time_zone],
      ["Damaged jobs", Object.keys(service.damaged).length === 0 ? "None" : null],
    ]} /></div>`;
}

/** A verification on record, as a link of the calendar leads to it. */
const Kept = ({id, may, verified}) => html`<div class="box"><div class="between"><h3>A verification on record</h3><a href="#/health">Close</a></div>
  <${Verification} id=${id} may=${may} verified=${verified} /></div>`;

function State({health}) {
  const [kind, word] = STATES[health.state];
  const latest = health.latest;
  const age_s = health.calibration_age_s;
  const size = latest?.scale_percent ?? null;
  return html`<div class="box">
    <p class="quiet">The calibration is</p>
    <p class=${`verdict ${kind}`} role="status">${word}</p>
    <ul>${health.reasons.map((reason) => html`<li>${begun(reason)}</li>`)}</ul>
    ${health.remedy && html`<p><strong>What to do:</strong> ${begun(health.remedy)}.${!health.calibration && html` <a href="#/calibrate">Calibrate</a>`}</p>`}
    <${Facts} of=${[
      ["Last verified", moment(latest?.at)],
      ["Age of the calibration", age_s === null ? null : duration(age_s)],
      ["Expected error of a scan", health.expected_error_mm && length(health.expected_error_mm)],
      ["Change since calibration", change(latest) === null ? null : written(change(latest))],
      ["Board against its print", size === null ? null : `${thousandths(size)}${latest.scale_sigma_percent ? ` ± ${thousandths(latest.scale_sigma_percent)}` : ""}\u00a0%`],
      ["If stale", health.refuses_scans_when_stale ? "Scans are refused" : "Scans are allowed and flagged"],
    ]} />
  </div>`;
}

/** One shot of the board. One that is under way is shown to everybody who looks, also after the page was loaded anew. */
function Verify({rig, may, verified}) {
  const known = useBoard(rig);
  const [board, setBoard] = useState(USUAL_BOARD);
  const [position, setPosition] = useState(null);
  const [shown, setShown] = useState(null);
  const other = [rig?.holder, ...(rig?.computing ?? [])].map((name) => /^verification (.+)$/.exec(name ?? "")?.[1]).find(Boolean);
  useEffect(() => {
    if (other) setShown(other);
  }, [other]);
  const [start, busy, refused] = useAction(async () => {
    const body = {if_busy: "queue", ...(known ? {} : {board}), ...(position === null ? {} : {position})};
    setShown((await ask("POST", "/rig/verification", {body, headers: once()})).id);
  });
  return html`<div class="box">
    <h3>Verify now</h3>
    <p>${known ? html`Stand the board of this calibration before the camera: ${known.title}.` : "Stand the calibration board before the camera."}
      ${" "}Whole, in focus, and still while it is shot: on a stand, not in the hand.</p>
    ${known === null && rig.calibrated && html`<${BoardFields} board=${board} changed=${setBoard} />`}
    <div class="row">
      <${PositionField} rig=${rig} value=${position} chosen=${setPosition} />
      <${Action} kind="primary" busy=${busy} disabled=${!may("calibrate") || known === undefined || !rig?.calibrated} onClick=${start}>Verify now<//>
    </div>
    ${rig?.calibrated === false && html`<p class="warning">The rig has no calibration that could be verified. <a href="#/calibrate">Calibrate</a></p>`}
    ${!may("calibrate") && html`<p class="quiet">Your key is not for calibrations.</p>`}
    <${Refusal} problem=${refused} />
    ${shown && html`<${Verification} key=${shown} id=${shown} may=${may} verified=${verified} />`}
  </div>`;
}

function Verification({id, may, verified}) {
  const here = `/rig/verification/${id}`;
  const [told, setTold] = useState({stage: "Waiting for the rig", fraction: 0});
  const [body, problem, again] = useValue(here);
  useEffect(() => {
    const look = () => Promise.all([again(), verified()]);
    return follow(`${here}/events`, (kind, data) => {
      if (kind === "progress") setTold(data);
      if (kind === "state") look();
    }, look);
  }, [id]);
  const [cancel, busy, refused] = useAction(() => ask("POST", `${here}/cancel`));
  if (problem) return html`<${Refusal} problem=${problem} />`;
  if (body?.error) return html`<${Refusal} problem=${{document: {title: "Nothing was found out"}, message: body.error.detail}} />`;
  if (body?.found) return html`<${Found} found=${body.found} />`;
  if (body?.state === "cancelled") return html`<p role="status">The verification was stopped.</p>`;
  return html`<${Progress} label=${told.stage} fraction=${told.fraction} detail=${told.detail} />
    ${may("calibrate") && html`<${Action} busy=${busy} onClick=${cancel}>Stop it<//>`}<${Refusal} problem=${refused} />`;
}

function Found({found}) {
  const [kind, word] = STATES[found.state];
  const [cause] = found.drifts;
  const reasons = found.reasons.filter((reason) => ![cause?.words, found.open].includes(reason));
  return html`<div role="status">
    <p><${Badge} kind=${kind}>${word}<//> ${begun(reasons.join("; "))}.</p>
    ${cause && html`<p><strong>Likely cause:</strong> ${begun(cause.words)} <span class="quiet">(${cause.device}; ${percent(cause.weight)} likely among what was tried, ${number(cause.significance, {decimals: 1})} σ)</span></p>`}
    ${found.open && html`<p class="quiet">${found.open}</p>`}
    ${found.unseen.length > 0 && html`<p class="warning">Nothing was learned of ${found.unseen.join(", ")}.</p>`}
    ${found.remedy && html`<p><strong>What to do:</strong> ${begun(found.remedy)}.</p>`}
  </div>`;
}

const disagreement = ({pairs}) => pairs.map((pair) => [Math.abs(pair.mean_px), pair]).sort(([a], [b]) => b - a)[0];

/** Pictures of the newest verifications. */
function Trends({records, at}) {
  const drawn = (value) => records.filter((record) => Number.isFinite(value(record))).map((record) => (
    {at: new Date(record.at), value: value(record), kind: STATES[record.state][0], words: record.reasons.join("; ")})).reverse();
  const changes = drawn(change), means = drawn((record) => disagreement(record)?.[0]);
  if (records.length === 0) return html`<p class="quiet">Nothing was verified yet. “Verify now” shoots the first; a nightly verification shows a trend.</p>`;
  return html`<h3>Trend</h3>
    ${changes.length > 0 && html`<${Trend} title="Change since calibration, mm" points=${changes} limits=${[]} />`}
    ${means.length > 0 && html`<${Trend} title="Largest mean disagreement of two devices, px" points=${means} limits=${[[at.watch_mean_px, "Watch", "warn"], [at.stale_mean_px, "Stale", "bad"]]} />`}
    <p class="quiet">Watch from ${number(at.watch_mean_px)} px of mean disagreement on, or ${number(at.watch_error_ratio)} times the error as calibrated (without the board's size); stale from ${number(at.stale_mean_px)} px, or ${number(at.stale_error_ratio)} times. Judged by the last three together.</p>`;
}

/** The same as a table, the newest first. */
const Records = ({records}) => html`<div class="wide" tabindex="0" role="region" aria-label="Last verifications">
  <table class="broad"><caption>Last verifications</caption>
    <thead><tr>${["When", "State", "By", "Change since calibration", "Largest mean disagreement", "Why"].map((head) => html`<th scope="col">${head}</th>`)}</tr></thead>
    <tbody>${records.map((record) => {
      const [largest_px, pair] = disagreement(record) ?? [];
      return html`<tr key=${record.id}>
        <td>${moment(record.at)}</td><td><${Badge} kind=${STATES[record.state][0]}>${STATES[record.state][1]}<//></td>
        <td>${record.kind === "scan" ? "A scan" : "The board"}</td>
        <td>${change(record) === null ? "Not known" : written(change(record))}</td>
        <td>${pair ? `${thousandths(largest_px)} px (${pair.first}, ${pair.second})` : "Not known"}</td>
        <td>${begun(record.reasons.join("; "))}</td></tr>`;
    })}</tbody>
  </table>
</div>`;
