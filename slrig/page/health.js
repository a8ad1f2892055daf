// Health: whether the calibration still holds, a look at it now, and how it went over time; and what the clock does.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {BoardFields, PositionField, USUAL_BOARD, useBoard} from "./board.js";
import {Schedules} from "./schedule.js";
import {ask, follow, once, useAction, useValue} from "./service.js";
import {Action, Badge, Facts, Progress, Refusal, length, moment, percent} from "./ui.js";

const STATES = {good: ["good", "Good"], watch: ["warn", "Watch"], stale: ["bad", "Stale"], unknown: ["busy", "Not known"]};
const DAY_S = 86400;

/** By how much what changed since the calibration moves a point of a scan; null where a verification does not tell. */
function change(verification) {
  const moved_mm = verification?.drift_mm ?? null;
  return moved_mm === null ? null : moved_mm === 0 ? "none found" : length(moved_mm);
}
const hundredths = (percents) => Number(percents.toFixed(3));

export function HealthScreen({rig, may}) {
  const [health, problem, again] = useValue("/rig/health", 5);
  return html`<h2 class="hidden">Health</h2>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${health && html`<div class="two">
      <section aria-label="State"><${State} health=${health} /></section>
      <section aria-label="Verify"><${Verify} rig=${rig} may=${may} verified=${again} /></section>
    </div>
    <section aria-label="Trend"><${Trend} health=${health} /></section>`}
    <section aria-label="Schedule"><${Schedules} rig=${rig} may=${may} /></section>`;
}

function State({health}) {
  const [kind, word] = STATES[health.state];
  const latest = health.latest;
  const age_s = health.calibration_age_s;
  const size = latest?.scale_percent ?? null;
  return html`<div class="box">
    <p class="quiet">The calibration is</p>
    <p class=${`verdict ${kind}`} role="status">${word}</p>
    <ul>${health.reasons.map((reason) => html`<li>${reason}</li>`)}</ul>
    ${health.remedy && html`<p><strong>What to do:</strong> ${health.remedy}.${!health.calibration && html` <a href="#/calibrate">Calibrate</a>`}</p>`}
    <${Facts} of=${[
      ["Last verified", moment(latest?.at)],
      ["Age of the calibration", age_s === null ? null : age_s < DAY_S ? "less than a day" : `${Math.floor(age_s / DAY_S)} days`],
      ["Expected error of a scan", health.expected_error_mm && length(health.expected_error_mm)],
      ["Change since calibration", change(latest)],
      ["Board against its print", size === null ? null : `${hundredths(size)}${latest.scale_sigma_percent ? ` ± ${hundredths(latest.scale_sigma_percent)}` : ""} %`],
      ["Scans while it is stale", health.refuses_scans_when_stale ? "refused" : "made, and marked so"],
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
  const [told, setTold] = useState({stage: "waits for the rig", fraction: 0});
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
    <p><${Badge} kind=${kind}>${word}<//> ${reasons.join("; ")}.</p>
    ${cause && html`<p><strong>Likely cause:</strong> ${cause.words} <span class="quiet">(${cause.device}; ${percent(cause.weight)} likely among what was tried, ${cause.significance.toFixed(1)} σ)</span></p>`}
    ${found.open && html`<p class="quiet">${found.open}</p>`}
    ${found.unseen.length > 0 && html`<p class="warning">Nothing was learned of ${found.unseen.join(", ")}.</p>`}
    ${found.remedy && html`<p><strong>What to do:</strong> ${found.remedy}.</p>`}
  </div>`;
}

/** A picture for the eye, and the same as a table: the newest verifications, first the last. */
function Trend({health}) {
  const newest = health.latest?.id ?? "none";
  const [page, problem, again] = useValue("/rig/health/history?limit=20");
  useEffect(() => {
    again();
  }, [newest]);
  const records = page?.verifications ?? [];
  const at = health.thresholds;
  const mean = ({pairs}) => pairs.map((pair) => [Math.abs(pair.mean_px), pair]).sort(([a], [b]) => b - a)[0];
  return html`<h2>Trend</h2>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${page && records.length === 0 && html`<p class="quiet">Nothing was verified yet. The button above shoots the first.</p>`}
    ${records.length > 0 && html`
      <div class="wide" tabindex="0" role="region" aria-label="Picture of the trend">
        <img class="trend" src=${`/rig/health.svg?newest=${records[0].id}`} alt="Change since calibration, and disagreement of the devices, over time, with their thresholds. The table below has the figures of the last ones." />
      </div>
      <p class="quiet">To be watched from ${at.watch_mean_px} px of mean disagreement on, or ${at.watch_error_ratio} times the error as calibrated (without the board's size); stale from ${at.stale_mean_px} px, or ${at.stale_error_ratio} times. Judged by the last three together.</p>
      <div class="wide" tabindex="0" role="region" aria-label="Last verifications">
        <table class="broad"><caption>Last verifications</caption>
          <thead><tr>${["When", "State", "By", "Change since calibration", "Largest mean disagreement", "Why"].map((head) => html`<th scope="col">${head}</th>`)}</tr></thead>
          <tbody>${records.map((record) => {
            const [largest_px, pair] = mean(record) ?? [];
            return html`<tr key=${record.id}>
              <td>${moment(record.at)}</td><td><${Badge} kind=${STATES[record.state][0]}>${STATES[record.state][1]}<//></td>
              <td>${record.kind === "scan" ? "a scan" : "the board"}</td>
              <td>${change(record) ?? "not told"}</td>
              <td>${pair ? `${largest_px.toFixed(3)} px (${pair.first}, ${pair.second})` : "not told"}</td>
              <td>${record.reasons.join("; ")}</td></tr>`;
          })}</tbody>
        </table>
      </div>`}`;
}
