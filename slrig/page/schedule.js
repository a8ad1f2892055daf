// Schedule: what the rig does by the clock, a calendar of what became of it, and how a person adds, pauses and starts it.
import {html, useState} from "./vendor/preact-htm.js";
import {BoardFields, PositionField, USUAL_BOARD, useBoard} from "./board.js";
import {ask, useAction, useValue} from "./service.js";
import {Action, Badge, Choice, Confirm, Refusal, begun, count} from "./ui.js";

const TASKS = {verification: "Verification", calibration: "Calibration", acceptance: "Acceptance test", scan: "Scan"};
const PURPOSES = [
  ["verification", "Nightly verification", {days: "*", time: "02:00"}],
  ["calibration", "Weekly calibration", {days: "sun", time: "03:00"}],
  ["acceptance", "Monthly acceptance test", {days: "1", time: "04:00"}],
  ["scan", "Daily scan", {days: "mon-fri", time: "06:00"}],
];
const WEEK = {mon: "Monday", tue: "Tuesday", wed: "Wednesday", thu: "Thursday", fri: "Friday", sat: "Saturday", sun: "Sunday"};
const DAYS = [["*", "Every day"], ["mon-fri", "Working days"], ...Object.entries(WEEK), ["1", "The 1st of each month"], ["15", "The 15th of each month"]];
const STATES = {
  waiting: ["busy", "…", "Waiting for the rig"], running: ["busy", "…", "Under way"], succeeded: ["good", "✓", "Done"],
  failed: ["bad", "✗", "Failed"], interrupted: ["bad", "✗", "Interrupted"], skipped: ["warn", "!", "Skipped: the rig was busy"],
  missed: ["warn", "!", "Missed"], coalesced: ["", "·", "Left to a newer one"],
};
const HEALTH = {good: ["good", "✓", "Good"], watch: ["warn", "!", "Watch"], stale: ["bad", "✗", "Stale"]};
const WORST = ["busy", "bad", "warn", "good", ""];
const KEPT = 200;
const pending = (run) => ["waiting", "running"].includes(run.state);

/** The fields of cron of a choice of days and a time. */
export const cronOf = ({days, time}) => {
  const [hour, minute] = time.split(":").map(Number);
  const monthly = /^\d/.test(days);
  return `${minute} ${hour} ${monthly ? days : "*"} * ${monthly ? "*" : days}`;
};

/** When a schedule is due, in words; cron's text where it says more than a day and a time. */
export function when(cron) {
  const [minute, hour, date, month, days] = cron.split(/\s+/);
  const words = DAYS.find(([each]) => each === (date === "*" ? days : days === "*" ? date : null))?.[1];
  if (!words || month !== "*" || !/^\d+$/.test(minute) || !/^\d+$/.test(hour)) return `At ${cron}`;
  return `${words} at ${hour.padStart(2, "0")}:${minute.padStart(2, "0")}`;
}

/** A due time as the clocks of its schedule show it: the text has them before its offset. */
const shown = (text, options) => new Date(`${text.slice(0, 19)}Z`).toLocaleString("en-GB", {...options, timeZone: "UTC"});
const clock = (text) => shown(text, {weekday: "short", day: "numeric", month: "short", hour: "2-digit", minute: "2-digit"});

export function Schedules({rig, may, zone}) {
  const [list, problem, again] = useValue("/schedule", 5);
  const schedules = list?.schedules ?? [];
  return html`<h2>Schedule</h2>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${list && schedules.length === 0 && html`<p class="quiet">No scheduled tasks. ${may("administer") && "Add a nightly verification below: it tells you when the calibration no longer holds."}</p>`}
    ${schedules.map((each) => html`<${Schedule} key=${each.id} schedule=${each} changed=${again} may=${may} />`)}
    ${may("administer") ? zone && html`<${Add} rig=${rig} added=${again} zone=${zone} />` : html`<p class="quiet">Changing the schedule takes a key that may administer.</p>`}`;
}

function Schedule({schedule, changed, may}) {
  const {links, enabled} = schedule;
  const [removed, setRemoved] = useState(false);
  const [hurry, setHurry] = useState(true);
  const [page, , look] = useValue(removed ? null : `${links.runs}?limit=${KEPT}`, hurry ? 3 : 15);
  const [asking, setAsking] = useState(false);
  const [act, busy, problem] = useAction(async (method, path) => {
    setRemoved(method === "DELETE");
    await ask(method, path);
    await Promise.all([changed(), method === "DELETE" ? null : look()]);
  });
  const runs = page?.runs ?? [];
  const current = runs.find(pending);
  if (page && hurry !== Boolean(current)) setHurry(Boolean(current));
  const name = schedule.label ?? TASKS[schedule.task];
  const heading = `schedule-${schedule.id}`;
  return html`<section class="box" aria-labelledby=${heading}>
    <div class="between"><h3 id=${heading}>${name}</h3>
      ${current ? html`<${Badge} kind="busy">${STATES[current.state][2]}<//>` : html`<${Badge} kind=${enabled ? "good" : "warn"}>${enabled ? "On" : "Paused"}<//>`}</div>
    <p>${TASKS[schedule.task]}. ${when(schedule.cron)}, ${schedule.time_zone}. ${enabled ? html`Next: <strong>${clock(schedule.upcoming[0])}</strong>.` : "Paused: nothing becomes due."}</p>
    ${may("administer") && html`<div class="row">
      <${Action} busy=${busy} disabled=${Boolean(current)} onClick=${() => act("POST", links.run)}>Run now<//>
      ${current?.state === "running" && html`<${Action} busy=${busy} onClick=${() => act("POST", `${links.self}/cancel`)}>Stop this run<//>`}
      <${Action} busy=${busy} onClick=${() => act("POST", enabled ? links.pause : links.resume)}>${enabled ? "Pause" : "Resume"}<//>
      <${Action} busy=${busy} onClick=${() => setAsking(true)}>Remove<//>
    </div>`}
    ${asking && html`<${Confirm} question=${`Remove “${name}”, and the record of its runs?`} yes="Remove it" onYes=${() => act("DELETE", links.self)} onNo=${() => setAsking(false)} />`}
    <${Refusal} problem=${problem} />
    ${page && html`<${Calendar} runs=${runs} more=${page.next} upcoming=${enabled ? schedule.upcoming : []} name=${name} />`}
    <details><summary>More</summary>
      <p>Next five times: ${schedule.upcoming.map(clock).join(", ")}.</p><p>As cron has it: <code>${schedule.cron}</code></p></details>
  </section>`;
}

/** What a run came to: kind, mark, word. One that was done is as good as what it found. */
function outcome({state, result}) {
  if (state === "succeeded" && result?.verification) return HEALTH[result.state] ?? ["warn", "!", "Nothing learned"];
  if (state === "succeeded" && result?.acceptance) return {passes: ["good", "✓", "Passed"], fails: ["bad", "✗", "Failed"]}[result.decision] ?? ["warn", "!", "Undecided"];
  return STATES[state];
}

/** The weeks of a month, Monday first: dates as text, and null beside the month. */
export function weeks(month) {
  const [year, number] = month.split("-").map(Number);
  const before = (new Date(Date.UTC(year, number - 1, 1)).getUTCDay() + 6) % 7;
  const days = new Date(Date.UTC(year, number, 0)).getUTCDate();
  const dates = [...Array(before).fill(null), ...Array.from({length: days}, (_, at) => `${month}-${String(at + 1).padStart(2, "0")}`)];
  return Array.from({length: Math.ceil(dates.length / 7)}, (_, week) => Array.from({length: 7}, (_, day) => dates[7 * week + day] ?? null));
}

const beside = (month, step) => new Date(Date.UTC(...month.split("-").map((part, at) => Number(part) - at + at * step), 1)).toISOString().slice(0, 7);

/** A month of days, each with its worst outcome; the runs of a chosen day are below. */
function Calendar({runs, more, upcoming, name}) {
  const newest = (runs[0]?.due ?? upcoming[0] ?? new Date().toISOString()).slice(0, 7);
  const [month, setMonth] = useState(null);
  const [day, setDay] = useState(null);
  const at = month ?? newest;
  const of = (date) => runs.filter((run) => run.due.slice(0, 10) === date);
  const worst = (date) => of(date).map(outcome).sort(([a], [b]) => WORST.indexOf(a) - WORST.indexOf(b))[0];
  const due = (date) => upcoming.some((each) => each.slice(0, 10) === date);
  const chosen = day?.startsWith(at) ? day : runs.find((run) => run.due.startsWith(at))?.due.slice(0, 10);
  const title = shown(`${at}-01T00:00:00`, {month: "long", year: "numeric"});
  const oldest = runs.at(-1)?.due.slice(0, 7) ?? newest;
  return html`<div class="calendar">
    <div class="between"><strong role="status">${title}</strong><span>
      <${Action} kind="plain" aria-label="Month before" disabled=${at <= oldest} onClick=${() => setMonth(beside(at, -1))}>‹<//>
      <${Action} kind="plain" aria-label="Month after" disabled=${at >= (upcoming.at(-1) ?? newest).slice(0, 7) && at >= newest} onClick=${() => setMonth(beside(at, 1))}>›<//></span></div>
    <table><caption class="hidden">Results of ${name}, ${title}</caption>
      <thead><tr>${Object.values(WEEK).map((each) => html`<th scope="col"><abbr title=${each}>${each.slice(0, 2)}</abbr></th>`)}</tr></thead>
      <tbody>${weeks(at).map((week) => html`<tr>${week.map((date) => {
        const [kind, mark, word] = (date && worst(date)) ?? [];
        const number = date && Number(date.slice(8));
        return html`<td>${mark ? html`<button type="button" class=${`day ${kind}`} aria-pressed=${date === chosen} aria-label=${`${number} ${title}: ${word}`} onClick=${() => setDay(date)}>${number}<span>${mark}</span></button>`
          : number && html`<span class="day quiet">${number}${due(date) && html`<span title="Due">○</span>`}</span>`}</td>`;
      })}</tr>`)}</tbody></table>
    <p class="legend">✓ done and good, ! to be looked at, ✗ failed or not good, ○ due${more && at <= oldest ? `. The last ${KEPT} runs are shown` : ""}</p>
  </div>
  ${runs.length === 0 ? html`<p class="quiet">Nothing was due yet.</p>` : html`<ul class="findings" aria-label=${`Runs of ${name}`}>${of(chosen).map((run) => {
    const [kind, , word] = outcome(run);
    return html`<li key=${run.number}><${Badge} kind=${kind}>${word}<//> <strong>${clock(run.due)}</strong>${run.count > 1 && ` × ${run.count}`}
      <p>${[run.reason, found(run.result)].filter(Boolean).map((words) => `${begun(words)}.`).join(" ")} ${record(run.result)}</p></li>`;
  })}</ul>`}`;
}

/** What a run found, in words. */
function found(result) {
  if (!result) return null;
  if (result.verification) return `The calibration is ${result.state === "watch" ? "to be watched" : result.state}: ${result.reasons.join("; ")}`;
  if (result.acceptance) return `The acceptance test: ${result.decision}`;
  if (result.scan) return `${count(result.points)} points`;
  return `${result.accepted} of ${result.poses} poses taken. ${result.verdict ?? ""} ${result.activated ? "In use" : `Not in use${result.left_to_a_person.length ? `, left to a person: ${result.left_to_a_person.join("; ")}` : ""}`}`;
}

/** Where the record of what a run found is. */
function record(result) {
  if (result?.verification) return html`<a href=${`#/health/${result.verification}`}>Show the verification</a>`;
  if (result?.calibration) return html`<a href=${`#/calibrate/${result.calibration}`}>Show the calibration</a>`;
  if (result?.scan) return html`<a href=${`#/scan/${result.scan}`}>Show the scan</a>`;
  return result?.acceptance && html`<a href=${`/acceptance/${result.acceptance}/report.html`} target="_blank">Show the report</a>`;
}

function Add({rig, added, zone}) {
  const known = useBoard(rig);
  const [asked, setAsked] = useState({task: PURPOSES[0][0], ...PURPOSES[0][2], cron: "", label: "", time_zone: zone});
  const [board, setBoard] = useState(USUAL_BOARD);
  const [position, setPosition] = useState(null);
  const [activate, setActivate] = useState(false);
  const [made, setMade] = useState(null);
  const {task} = asked;
  const positioned = rig?.positions.length > 0;
  const needsBoard = task === "calibration" || (task === "verification" && known === null);
  const cron = asked.cron.trim() || cronOf(asked);
  const [add, busy, refused] = useAction(async () => {
    setMade(null);
    const options = {
      ...(needsBoard ? {board: known ? printed(known) : board} : {}),
      ...(task === "verification" && position !== null ? {position} : {}),
      ...(task === "calibration" ? {activate} : {}),
      ...(task === "scan" && asked.label.trim() ? {label: asked.label.trim()} : {}),
    };
    setMade(await ask("POST", "/schedule", {body: {task, cron, time_zone: asked.time_zone.trim(), label: asked.label.trim() || null, options}}));
    setAsked((before) => ({...before, label: ""}));
    await added();
  });
  const submit = (event) => {
    event.preventDefault();
    add();
  };
  const field = (name, words, given = {}) => html`<label>${words}
    <input value=${asked[name]} onInput=${(event) => setAsked({...asked, [name]: event.target.value})} ...${given} /></label>`;
  const purposes = PURPOSES.filter(([each]) => positioned || ["verification", "scan"].includes(each));
  return html`<form class="box" aria-label="Add to the schedule" onSubmit=${submit}>
    <h3>Add to the schedule</h3>
    <${Choice} label="Purpose" value=${task} options=${purposes.map(([each, words]) => [each, words])}
      chosen=${(each) => setAsked({...asked, task: each, ...PURPOSES.find(([name]) => name === each)[2]})} />
    ${rig?.open && !positioned && html`<p class="quiet">A scheduled calibration or acceptance test needs something that moves the board; this rig has no positioner.</p>`}
    <div class="row">
      <label>Days <select value=${asked.days} disabled=${Boolean(asked.cron)} onChange=${(event) => setAsked({...asked, days: event.target.value})}>${DAYS.map(([each, words]) => html`<option value=${each}>${words}</option>`)}</select></label>
      ${field("time", "Time", {type: "time", required: true, disabled: Boolean(asked.cron)})}
      ${task === "verification" && html`<${PositionField} rig=${rig} value=${position} chosen=${setPosition} />`}
      ${field("label", "Name (optional)", {maxlength: 200})}
    </div>
    ${needsBoard && known === null && html`<${BoardFields} board=${board} changed=${setBoard} />`}
    ${task === "verification" && !positioned && html`<p class="quiet">The board must stand in view at that time.</p>`}
    ${task === "calibration" && html`<p><label class="tick"><input type="checkbox" checked=${activate} onChange=${(event) => setActivate(event.target.checked)} /> Use the new calibration, unless its verdict asks for a person</label></p>`}
    ${task === "acceptance" && html`<p class="quiet">On a rig that is not simulated, name the artefacts and their certificates by command: <code>slrig schedule add '${cron}' acceptance --option artefacts=…</code></p>`}
    <details><summary>More</summary><div class="row">
      ${field("time_zone", "Time zone", {required: true, spellcheck: false})}
      ${field("cron", "Cron: minute, hour, day, month, weekday", {placeholder: cronOf(asked), spellcheck: false})}</div></details>
    <p>${when(cron)}, by the clocks of ${asked.time_zone}.</p>
    <${Action} kind="primary" busy=${busy} type="submit">Add<//>
    <${Refusal} problem=${refused} />
    <div role="status">${made && html`<p>Added. Next: ${made.upcoming.map(clock).join(", ")}.</p>`}</div>
  </form>`;
}

/** A board of a calibration as a schedule's options take it. */
const printed = ({kind, corners, square_mm, marker_mm, dictionary, square_sigma, aspect}) => ({kind, corners, square_mm, marker_mm, dictionary, square_sigma, aspect});
