// The poses of a calibration: shot by hand, by a timer or by the positioner, and read from a few steps away.
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";
import {Live} from "./live.js";
import {ask, follow, once, useAction} from "./service.js";
import {Action, Badge, Choice, JobBadge, Progress, Refusal, begun, percent} from "./ui.js";

const over = (pose) => !["queued", "capturing", "computing"].includes(pose.state);
const WAITS_S = [3, 5, 10, 20];

/** What became of a pose: how it is coloured, its sign, and a word. */
function outcome(pose) {
  if (pose.accepted) return ["good", "✓", "accepted"];
  if (pose.accepted === false) return ["bad", "✗", "refused"];
  return pose.state === "cancelled" ? ["warn", "–", "stopped"] : ["bad", "✗", "failed"];
}

/** What to do with the board now: [in a few words, why]. */
function instruction(session, pose) {
  if (session.state === "solving") return ["Solving …", null];
  if (pose?.state === "computing") return ["You may move the board.", "It is being read. What to do next comes in a moment."];
  if (pose?.state === "queued") return ["Wait: the rig is not free yet.", "The pose is shot as soon as it is."];
  if (pose) return [pose.position === null ? "Hold the board still." : `The positioner is at work: ${pose.position_name ?? pose.position}.`, null];
  if (!session.next_move) return [`Hold the board where every camera sees it${session.patterns.codes ? " and the projector's light falls on it" : ""}, and keep it still.`, null];
  const {words} = session.next_move;
  const cut = words.indexOf(": ");
  const [first, why] = cut < 0 ? [words, null] : [words.slice(0, cut), words.slice(cut + 2)];
  return [`${begun(first)}.`, why && `${begun(why)}.`];
}

export function Shooting({session, rig, able, may, again}) {
  const {links} = session;
  const pose = session.shot.find((each) => !over(each));
  const last = session.shot.findLast(over);
  const solving = session.state === "solving";
  const enough = Boolean(session.next_move?.enough);
  const [told, setTold] = useState(null);
  const [voice, setVoice] = useState(false);
  const place = useRef();
  const [words, why] = instruction(session, pose);
  const speak = (text) => {
    if (voice) speechSynthesis.speak(new SpeechSynthesisUtterance(text));
  };
  const [shoot, sending, refused] = useAction(async () => {
    tone.allow();
    await ask("POST", links.pose, {body: {if_busy: "queue"}, headers: once()});
    await again();
    return true;
  });
  const [script, beginning, unscripted] = useAction(async () => {
    await ask("POST", `${links.self}/script`, {body: {if_busy: "queue"}, headers: once()});
    await again();
  });
  const [solve, posting, unsolved] = useAction(async () => {
    await ask("POST", links.solve, {body: {}});
    await again();
  });
  const [stop, stopping, unstopped] = useAction(async () => {
    await ask("POST", pose.links.cancel);
    await again();
  });
  const idle = !pose && !solving && !sending && !beginning && !posting && session.script.length === 0;
  const timer = useTimer(idle, shoot);
  useShutter(timer, able && idle ? shoot : null);

  const doing = solving ? "solve" : pose?.number ?? null;
  useEffect(() => {
    setTold(null);
    if (doing === null) return undefined;
    const mine = solving ? null : doing;
    return follow(links.events, (kind, data) => {
      // Events of the poses before come first.
      if (kind === "state" ? !solving : data.pose !== mine) return;
      if (kind === "progress") setTold(data);
      else again();
      if (kind === "captured") tone.play();
    }, again);
  }, [doing]);
  // A timer goes on until enough is covered, or until something else than the board is in its way.
  const blocked = last && last.accepted === null ? last.number : null;
  useEffect(() => timer.stop(), [blocked, enough, solving]);
  useEffect(() => {
    if (timer.running) place.current.scrollIntoView();
  }, [timer.running]);
  useEffect(() => speak(words), [words, voice]);
  useEffect(() => {
    if (last) speak(`${last.name} ${outcome(last)[2]}`);
  }, [last?.number]);

  const progress = told ?? session.progress;
  const ready = able && idle;
  return html`<div class="two"><section aria-label="Live picture"><${Live} plain rig=${rig} may=${may} aim=${pose ? null : session.next_move} /></section>
  <div><section class="box" aria-label="Shooting" ref=${place}>
    ${session.state === "solved" && html`<p class="quiet">More poses make it better:</p>`}
    ${timer.running && html`<p class="count" role="timer">${timer.left ?? "…"}</p>`}
    <p class="say" role="status">${words}</p>
    ${why && html`<p class="why">${why}</p>`}
    ${doing !== null && html`<${Progress} label=${progress?.stage ?? "waiting for the rig"} fraction=${progress?.fraction ?? 0} detail=${progress?.detail} />`}
    ${last && !solving && html`<${Judged} pose=${last} />`}
    ${session.error && html`<${Refusal} problem=${{document: session.error, message: session.error.detail}} />`}
    <div class="row">
      <${Action} kind=${enough ? "" : "primary"} disabled=${!ready} busy=${sending} onClick=${shoot}>Shoot (space bar)<//>
      ${timer.running ? html`<${Action} key="stop" kind="danger" onClick=${timer.stop}>Stop the timer (any key)<//>`
        : html`<${Action} key="start" disabled=${!ready} onClick=${() => { tone.allow(); timer.start(); }}>Shoot every ${timer.every_s} s<//>`}
      <${Choice} label="Seconds to move the board" value=${timer.every_s} options=${WAITS_S.map((each) => [each, `${each} s`])} chosen=${timer.setEvery} />
      ${rig?.positions.length > 0 && html`<${Action} disabled=${!ready} busy=${beginning} onClick=${script}>Capture all ${rig.positions.length} positions<//>`}
      ${pose && html`<${Action} kind="danger" disabled=${!able} busy=${stopping} onClick=${stop}>Stop${session.script.length ? `, with the ${session.script.length} to come` : ""}<//>`}
      <${Action} kind=${enough ? "primary" : ""} disabled=${!ready || session.poses === 0} busy=${posting} onClick=${solve}>Solve<//>
      ${"speechSynthesis" in window && html`<label class="tick"><input type="checkbox" checked=${voice} onChange=${(event) => setVoice(event.target.checked)} /> Speak</label>`}
    </div>
    ${[refused, unscripted, unsolved, unstopped].map((problem) => html`<${Refusal} problem=${problem} />`)}
  </section>
  <${Coverage} session=${session} /></div></div>`;
}

/** A pose's judgement, as it is read from two metres away. */
function Judged({pose}) {
  const [kind, sign, word] = outcome(pose);
  const [first, ...rest] = (pose.error?.detail ?? "").split(". ");
  return html`<div role="status"><p class=${`judged ${kind}`}><span aria-hidden="true">${sign} </span>Pose ${pose.number} ${word}${first && `: ${first}`}</p>
    ${rest.length > 0 && html`<p class="why">${rest.join(". ")}</p>`}
    ${pose.answer?.warnings?.map((each) => html`<p class="warning">${each}</p>`)}</div>`;
}

function Coverage({session}) {
  const {coverage} = session;
  if (!coverage) return null;
  return html`<section aria-label="Coverage">
    <p>${session.poses === 1 ? "1 pose" : `${session.poses} poses`} accepted. ${coverage.missing.length ? "Still wanted:" : "All is covered."}</p>
    <ul>${coverage.missing.map((each) => html`<li>${each}</li>`)}</ul>
    <div class="cards">${Object.entries(coverage.devices).map(([name, device]) => html`<${Covered} name=${name} device=${device} />`)}</div>
    <p class="legend">Poses that were seen in each part of the image:
      ${SHADES.map((words, shade) => html`<span><svg class="covered swatch" viewBox="0 0 1 1" aria-hidden="true"><rect class=${`n${shade}`} width="1" height="1" /></svg> ${words}</span>`)}
      <span><svg class="covered swatch" viewBox="0 0 1 1" aria-hidden="true"><rect class="never" width="1" height="1" /></svg> cannot be reached</span></p>
  </section>`;
}

const SHADES = ["none", "1", "2", "3 or more"];

/** What one device has seen of the board: how many poses in each of the cells of its image. */
function Covered({name, device}) {
  const rows = device.cells.length;
  const columns = device.cells[0].length;
  const words = `${name}: ${percent(Math.round(100 * device.share) / 100)} of the image covered`;
  return html`<figure class="seen"><svg class="covered" viewBox=${`0 0 ${columns} ${(0.75 * rows).toFixed(2)}`} role="img" aria-label=${words}>
    ${device.cells.flatMap((cells, row) => cells.map((poses, column) => html`<rect class=${device.reachable[row][column] ? `n${Math.min(poses, SHADES.length - 1)}` : "never"} x=${column} y=${0.75 * row} width="1" height="0.75" />
      ${poses > 0 && html`<text class=${`n${Math.min(poses, SHADES.length - 1)}`} x=${column + 0.5} y=${0.75 * row + 0.51}>${poses}</text>`}`))}
  </svg><figcaption>${words}</figcaption></figure>`;
}

/** Shots one after the other: `left` seconds are counted while `idle`, then `shoot` is called; a refusal ends it. */
function useTimer(idle, shoot) {
  const [every_s, setEvery] = useState(5);
  const [running, setRunning] = useState(false);
  const [left, setLeft] = useState(null);
  useEffect(() => {
    if (!running || !idle) return undefined;
    const until = Date.now() + 1000 * every_s;
    setLeft(every_s);
    const timer = setInterval(async () => {
      const rest = Math.ceil((until - Date.now()) / 1000);
      setLeft(Math.max(rest, 0));
      if (rest > 0) return;
      clearInterval(timer);
      if (!(await shoot())) setRunning(false);
    }, 100);
    return () => {
      clearInterval(timer);
      setLeft(null);
    };
  }, [running, idle, every_s]);
  return {every_s, setEvery, running, left, start: () => setRunning(true), stop: () => setRunning(false)};
}

/** The keyboard: any key stops a timer; the space bar shoots, unless it presses what has the focus. */
function useShutter(timer, shoot) {
  useEffect(() => {
    const pressed = (event) => {
      const space = event.code === "Space";
      if (timer.running) {
        timer.stop();
        if (space || event.code === "Enter") event.preventDefault();
      } else if (space && shoot && !event.repeat && !event.target.closest("a, button, input, select, summary, textarea")) {
        event.preventDefault();
        shoot();
      }
    };
    addEventListener("keydown", pressed);
    return () => removeEventListener("keydown", pressed);
  });
}

/** A tone. Browsers let a page sound only after somebody pressed something. */
const tone = {
  context: null,
  allow() {
    this.context ??= window.AudioContext ? new AudioContext() : null;
  },
  play() {
    if (!this.context) return;
    const source = this.context.createOscillator();
    source.frequency.value = 880;
    source.connect(this.context.destination);
    source.start();
    source.stop(this.context.currentTime + 0.25);
  },
};

/** Every pose that was shot, the newest first. */
export function Poses({session, able, again}) {
  return html`<section aria-labelledby="poses"><h2 id="poses">Poses</h2>
    <ul class="cards">${session.shot.toReversed().map((pose) => html`<${Pose} key=${pose.number} pose=${pose} able=${able && session.state !== "solving"} again=${again} />`)}</ul></section>`;
}

function Pose({pose, able, again}) {
  const [drop, busy, problem] = useAction(async () => {
    await ask("DELETE", pose.links.self);
    await again();
  });
  const [kind, sign, word] = outcome(pose);
  return html`<li class="card pose">
    ${Object.entries(pose.links.pictures).map(([camera, path]) => html`<a href=${path} target="_blank" rel="noopener"><img src=${path} alt=${`Pose ${pose.number}, camera ${camera}`} loading="lazy" /></a>`)}
    <span class="between"><strong>Pose ${pose.number}</strong>${over(pose) ? html`<${Badge} kind=${kind}>${sign} ${word}<//>` : html`<${JobBadge} state=${pose.state} />`}</span>
    ${facts(pose.answer ?? {}).map((each) => html`<span class="quiet">${each}</span>`)}
    ${pose.answer?.warnings?.map((each) => html`<span class="warning">${each}</span>`)}
    ${pose.error && html`<span>${pose.error.detail}</span>`}
    ${over(pose) && html`<${Action} disabled=${!able} busy=${busy} onClick=${drop}>Delete pose ${pose.number}<//>`}
    <${Refusal} problem=${problem} />
  </li>`;
}

/** By camera, what was found of a pose. */
function facts(answer) {
  const told = [["tilt_deg", (value) => `${value.toFixed(0)}° tilted`], ["distance_mm", (value) => `${value.toFixed(0)} mm away`],
    ["sharpness_px", (value) => `edges ${value.toFixed(1)} px soft`], ["moved_px", (value) => `moved ${value.toFixed(2)} px`],
    ["saturated", (value) => value > 0 && `${percent(value)} saturated`]];
  return Object.entries(answer.corners_found ?? {}).map(([camera, corners]) => {
    const known = told.map(([name, say]) => Number.isFinite(answer[name]?.[camera]) && say(answer[name][camera])).filter(Boolean);
    return `${camera}: ${[`${corners} of ${answer.corners_expected} corners`, ...known].join(", ")}`;
  });
}
