// Schedule: what the rig does by the clock, what became of it, and how a person adds, pauses and starts it.
import {html, useState} from "./vendor/preact-htm.js";
import {BoardFields, PositionField, USUAL_BOARD, useBoard} from "./board.js";
import {ask, useAction, useValue} from "./service.js";
import {Action, Badge, Choice, Confirm, Refusal} from "./ui.js";

const TASKS = {verification: "Verification", calibration: "Calibration", acceptance: "Acceptance test"};
const PRESETS = [
  ["verification", "0 2 * * *", "Verification, each night at 02:00"],
  ["calibration", "0 3 * * sun", "Calibration, Sundays at 03:00"],
  ["acceptance", "0 4 1 * *", "Acceptance test, the 1st of each month at 04:00"],
];
const KINDS = {succeeded: "good", failed: "bad", interrupted: "bad", skipped: "warn", missed: "warn", waiting: "busy", running: "busy"};
const MEANT = {
  waiting: "waits for the rig", running: "under way", coalesced: "left to a newer one", skipped: "skipped: the rig was busy", missed: "missed",
};
const pending = (run) => ["waiting", "running"].includes(run.state);

/** A due time as the clocks of its schedule show it: the text has them before its offset. */
const clock = (text) => new Date(`${text.slice(0, 19)}Z`).toLocaleString("en-GB", {
  weekday: "short", day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", timeZone: "UTC",
});

export function Schedules({rig, may}) {
  const [list, problem, again] = useValue("/schedule", 5);
  const schedules = list?.schedules ?? [];
  return html`<h2>Schedule</h2>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${list && schedules.length === 0 && html`<p class="quiet">Nothing is done by the clock yet.</p>`}
    ${schedules.map((each) => html`<${Schedule} key=${each.id} schedule=${each} changed=${again} may=${may} />`)}
    ${may("administer") ? html`<${Add} rig=${rig} added=${again} />` : html`<p class="quiet">Changing the schedule takes a key that may administer.</p>`}`;
}

function Schedule({schedule, changed, may}) {
  const {links, enabled} = schedule;
  const [removed, setRemoved] = useState(false);
  const [page, , look] = useValue(removed ? null : `${links.runs}?limit=10`, 3);
  const [asking, setAsking] = useState(false);
  const [act, busy, problem] = useAction(async (method, path) => {
    setRemoved(method === "DELETE");
    await ask(method, path);
    await Promise.all([changed(), method === "DELETE" ? null : look()]);
  });
  const runs = page?.runs ?? [];
  const current = runs.find(pending);
  const name = schedule.label ?? TASKS[schedule.task];
  const heading = `schedule-${schedule.id}`;
  return html`<section class="box" aria-labelledby=${heading}>
    <div class="between"><h3 id=${heading}>${name}</h3>
      ${current ? html`<${Badge} kind="busy">${MEANT[current.state]}<//>` : html`<${Badge} kind=${enabled ? "good" : "warn"}>${enabled ? "on" : "paused"}<//>`}</div>
    <p>${TASKS[schedule.task]}, ${enabled ? html`next <strong>${clock(schedule.upcoming[0])}</strong>` : "paused: nothing becomes due"}
      ${" "}<span class="quiet">(<code>${schedule.cron}</code>, ${schedule.time_zone})</span></p>
    ${may("administer") && html`<div class="row">
      <${Action} busy=${busy} disabled=${Boolean(current)} onClick=${() => act("POST", links.run)}>Run now<//>
      ${current?.state === "running" && html`<${Action} busy=${busy} onClick=${() => act("POST", `${links.self}/cancel`)}>Stop this run<//>`}
      <${Action} busy=${busy} onClick=${() => act("POST", enabled ? links.pause : links.resume)}>${enabled ? "Pause" : "Resume"}<//>
      <${Action} busy=${busy} onClick=${() => setAsking(true)}>Remove<//>
    </div>`}
    ${asking && html`<${Confirm} question=${`Remove “${name}”, and the record of its runs?`} yes="Remove it" onYes=${() => act("DELETE", links.self)} onNo=${() => setAsking(false)} />`}
    <${Refusal} problem=${problem} />
    <details><summary>Next five times</summary><ol>${schedule.upcoming.map((due) => html`<li>${clock(due)}</li>`)}</ol></details>
    ${page && runs.length === 0 ? html`<p class="quiet">Nothing was due yet.</p>` : html`<${Runs} runs=${runs} name=${name} />`}
  </section>`;
}

const Runs = ({runs, name}) => html`<div class="wide" tabindex="0" role="region" aria-label=${`Runs of ${name}`}>
  <table><caption>What became of its due times</caption>
    <thead><tr><th scope="col">Due</th><th scope="col">What became of it</th><th scope="col">Why, and what was found</th></tr></thead>
    <tbody>${runs.map((run) => html`<tr key=${run.number}>
      <td>${clock(run.due)}</td>
      <td><${Badge} kind=${KINDS[run.state]}>${MEANT[run.state] ?? run.state}<//>${run.count > 1 && ` × ${run.count}`}</td>
      <td>${[run.reason, found(run.result)].filter(Boolean).join(". ")}</td>
    </tr>`)}</tbody>
  </table>
</div>`;

/** What a run found, in words. */
function found(result) {
  if (!result) return null;
  if (result.verification) return `The calibration is ${result.state}: ${result.reasons.join("; ")}`;
  if (result.acceptance) return `The acceptance test: ${result.decision}`;
  return `${result.accepted} of ${result.poses} poses taken. ${result.verdict ?? ""} ${result.activated ? "Scans use it" : `Not in use${result.left_to_a_person.length ? `, left to a person: ${result.left_to_a_person.join("; ")}` : ""}`}`;
}

function Add({rig, added}) {
  const known = useBoard(rig);
  const [asked, setAsked] = useState({task: PRESETS[0][0], cron: PRESETS[0][1], label: "", time_zone: Intl.DateTimeFormat().resolvedOptions().timeZone});
  const [board, setBoard] = useState(USUAL_BOARD);
  const [position, setPosition] = useState(null);
  const [activate, setActivate] = useState(false);
  const [made, setMade] = useState(null);
  const {task} = asked;
  const positioned = rig?.positions.length > 0;
  const needsBoard = task === "calibration" || (task === "verification" && known === null);
  const [add, busy, refused] = useAction(async () => {
    setMade(null);
    const options = {
      ...(needsBoard ? {board: known ? printed(known) : board} : {}),
      ...(task === "verification" && position !== null ? {position} : {}),
      ...(task === "calibration" ? {activate} : {}),
    };
    setMade(await ask("POST", "/schedule", {body: {...asked, label: asked.label.trim() || null, options}}));
    await added();
  });
  const submit = (event) => {
    event.preventDefault();
    add();
  };
  const field = (name, words, given = {}) => html`<label>${words}
    <input value=${asked[name]} onInput=${(event) => setAsked({...asked, [name]: event.target.value})} ...${given} /></label>`;
  const presets = PRESETS.filter(([each]) => positioned || each === "verification");
  return html`<form class="box" aria-label="Add to the schedule" onSubmit=${submit}>
    <h3>Add to the schedule</h3>
    <${Choice} label="What, and when" value=${task} options=${presets.map(([each, , words]) => [each, words])}
      chosen=${(each) => setAsked({...asked, task: each, cron: PRESETS.find(([name]) => name === each)[1]})} />
    ${rig?.open && !positioned && html`<p class="quiet">A calibration or an acceptance test by the clock needs something that moves the board; this rig has no positioner.</p>`}
    <div class="row">
      ${field("cron", "Minute, hour, day, month, weekday", {required: true, spellcheck: false})}
      ${field("time_zone", "Time zone", {required: true, spellcheck: false})}
      ${field("label", "Name, if you like", {maxlength: 200})}
      ${task === "verification" && html`<${PositionField} rig=${rig} value=${position} chosen=${setPosition} />`}
    </div>
    ${needsBoard && known === null && html`<${BoardFields} board=${board} changed=${setBoard} />`}
    ${task === "verification" && !positioned && html`<p class="quiet">The board has to stand in view at that time.</p>`}
    ${task === "calibration" && html`<p><label class="tick"><input type="checkbox" checked=${activate} onChange=${(event) => setActivate(event.target.checked)} /> Scans use what comes of it, unless its verdict leaves that to a person</label></p>`}
    ${task === "acceptance" && html`<p class="quiet">Of a rig that is not rendered, the artefacts and their certificates are told by command: <code>slrig schedule add '${asked.cron}' acceptance --option artefacts=…</code></p>`}
    <${Action} kind="primary" busy=${busy} type="submit">Add<//>
    <${Refusal} problem=${refused} />
    <div role="status">${made && html`<p>Added. Next: ${made.upcoming.map(clock).join(", ")}.</p>`}</div>
  </form>`;
}

/** A board of a calibration as a schedule's options take it. */
const printed = ({kind, corners, square_mm, marker_mm, dictionary, square_sigma, aspect}) => ({kind, corners, square_mm, marker_mm, dictionary, square_sigma, aspect});
