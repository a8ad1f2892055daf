// Calibrate: a board to print, the calibrations that there are, and one of them from its first pose to its use.
import {html, useRef, useState} from "./vendor/preact-htm.js";
import {Poses, Shooting} from "./poses.js";
import {ask, useAction, useValue} from "./service.js";
import {Action, Badge, Choice, Confirm, Facts, Field, Refusal, begun, length, moment} from "./ui.js";

const USUAL = {kind: "charuco", columns: "11", rows: "8", square: "12", marker: "", dictionary: "", across: "", down: ""};
const KINDS = [["charuco", "ChArUco"], ["chessboard", "Chessboard"], ["circles", "Circles"]];
const STATES = {open: ["busy", "open"], solving: ["busy", "solving"], solved: ["good", "solved"], failed: ["bad", "solve failed"]};
const TYPES = {json: "application/json", yml: "application/yaml", yaml: "application/yaml", xml: "application/xml"};
const GRADES = {good: ["good", "✓"], usable: ["warn", "!"], do_not_use: ["bad", "✗"]};

const nameOf = (each) => each.label ?? `Calibration of ${moment(each.created_at)}`;

export function CalibrateScreen({rig, again, may, place}) {
  const able = may("calibrate");
  return html`
    ${!able && html`<p class="warning">Your key is for looking: it sees everything here, and changes nothing. One with the scope “calibrate” does (<code>slrig key add NAME --scope calibrate</code>).</p>`}
    ${place[0] ? html`<${Calibration} key=${place[0]} id=${place[0]} rig=${rig} looked=${again} able=${able} may=${may} />` : html`<${Calibrations} rig=${rig} able=${able} />`}`;
}

function Calibrations({rig, able}) {
  const [list, problem] = useValue("/calibration", 5);
  const all = list?.calibrations ?? [];
  const active = all.find((each) => each.active);
  const used = active ? html`Scans use <a href=${`#/calibrate/${active.id}`}>${nameOf(active)}</a>.`
    : rig?.calibrated ? "Scans use the rig file's calibration."
      : rig?.calibrated === false ? "This rig is not calibrated. Calibrate it before you scan." : "The rig is being opened.";
  return html`<div class="two">
    <section aria-labelledby="new"><h2 id="new">New calibration</h2><${Opening} able=${able} /></section>
    <section aria-labelledby="kept"><h2 id="kept">Calibrations</h2>
      <p>${used}</p>
      ${rig?.calibration?.error && html`<p class="warning">${rig.calibration.error}</p>`}
      <${Refusal} problem=${problem?.status ? problem : null} />
      ${list && !all.length && html`<p class="quiet">None is kept here yet.</p>`}
      <ul class="cards">${all.map((each) => html`<li key=${each.id}><a class="card" href=${`#/calibrate/${each.id}`}>
        <span class="between"><strong>${nameOf(each)}</strong><${States} of=${each} /></span>
        <span class="quiet">${each.imported ? "imported" : `${each.poses} poses`}, ${moment(each.solved_at ?? each.created_at)}</span>
        ${each.verdict && html`<span class="clip">${begun(each.verdict)}.</span>`}
      </a></li>`)}</ul>
      <${Importing} able=${able} />
      ${rig?.calibrated === false && html`<h3>Without a board</h3>
        <p>One scan of something with depth calibrates the rig roughly: its shape may be wrong by some tenths of a percent, and the scan says by how much. <a href="#/scan">Scan without a calibration</a></p>`}
    </section>
  </div>`;
}

const States = ({of}) => html`<span>${of.active && html`<${Badge} kind="good">in use<//> `}<${Badge} kind=${STATES[of.state][0]}>${of.imported ? "imported" : STATES[of.state][1]}<//></span>`;

/** The board: printed, measured, and then calibrated with. What was typed last is there again the next time. */
function Opening({able}) {
  const [board, setBoard] = useState(() => ({...USUAL, ...JSON.parse(localStorage.getItem("board") ?? "{}")}));
  const [label, setLabel] = useState("");
  const [alone, setAlone] = useState(false);
  const [page, setPage] = useState("A4");
  const of = (name) => ({value: board[name], change: (value) => setBoard((before) => ({...before, [name]: value}))});
  const charuco = board.kind === "charuco";
  const markers = charuco ? {...(board.marker && {marker_mm: Number(board.marker)}), ...(board.dictionary && {dictionary: board.dictionary})} : {};
  const [print, printing, unprintable] = useAction(async () => {
    const path = `/calibration/board.pdf?${new URLSearchParams({kind: board.kind, columns: board.columns, rows: board.rows, square_mm: board.square, ...markers, page})}`;
    // Asked for first: why a board cannot be printed is told here, and not in a file.
    await ask("GET", path);
    Object.assign(document.createElement("a"), {href: path, download: ""}).click();
  });
  const [open, opening, refused] = useAction(async () => {
    const measured = board.across && board.down ? {measured_mm: [Number(board.across), Number(board.down)]} : {};
    const asked = {kind: board.kind, corners: [Number(board.columns), Number(board.rows)], square_mm: Number(board.square), ...markers, ...measured};
    const made = await ask("POST", "/calibration", {body: {board: asked, projector: !alone, ...(label && {label})}});
    localStorage.setItem("board", JSON.stringify(board));
    location.hash = `#/calibrate/${made.id}`;
  });
  const submit = (event) => {
    event.preventDefault();
    open();
  };
  return html`<form onSubmit=${submit}>
    <div class="row"><${Choice} label="Board" value=${board.kind} options=${KINDS} chosen=${of("kind").change} />
      <${Action} kind="plain" onClick=${() => setBoard(USUAL)}>The usual board<//></div>
    <div class="row numbers">
      <${Field} label=${board.kind === "circles" ? "Circles in a row" : "Inner corners across"} ...${of("columns")} step="1" min="3" max="60" required />
      <${Field} label=${board.kind === "circles" ? "Rows" : "Inner corners down"} ...${of("rows")} step="1" min="3" max="60" required />
      <${Field} label=${board.kind === "circles" ? "From row to row, mm" : "Side of a square, mm"} ...${of("square")} required />
    </div>
    ${charuco && html`<details><summary>Markers of a board that was not printed here</summary><div class="row numbers">
      <${Field} label="Side of a marker, mm" ...${of("marker")} placeholder="0.75 of a square" />
      <${Field} label="Dictionary, by OpenCV's name" ...${of("dictionary")} type="text" placeholder="DICT_5X5_250" /></div></details>`}
    <h3>1. Print it</h3>
    <div class="row"><${Choice} label="Paper" value=${page} options=${[["A4", "A4"], ["A3", "A3"], ["letter", "Letter"], ["fit", "As large as it needs"]]} chosen=${setPage} />
      <${Action} busy=${printing} onClick=${print}>Board sheet (PDF)<//></div>
    <${Refusal} problem=${unprintable} />
    <p class="quiet">Print at 100 % (actual size), and glue the sheet on something flat and stiff.</p>
    <h3>2. Say what the two printed scales measure</h3>
    <div class="row numbers">
      <${Field} label="Scale below, mm" ...${of("across")} required=${Boolean(board.down)} />
      <${Field} label="Scale on the left, mm" ...${of("down")} required=${Boolean(board.across)} />
    </div>
    <p class="quiet">Hold a steel ruler to each, from its first to its last tick: a print that is 0.2 % too wide makes every scan 0.2 % wrong, and no pose tells it. Left empty, the print is taken to be right within 0.1 %.</p>
    <h3>3. Hold it before the rig</h3>
    <div class="row"><${Field} label="Name, if you like" value=${label} change=${setLabel} type="text" maxlength="100" />
      <label class="tick"><input type="checkbox" checked=${alone} onChange=${(event) => setAlone(event.target.checked)} /> Cameras alone, without the projector</label></div>
    ${alone && html`<p class="quiet">Such a calibration can be kept and exported. Scans cannot use it.</p>`}
    <${Refusal} problem=${refused} />
    <button class="action primary large" type="submit" aria-busy=${opening} disabled=${opening || !able}>Start</button>
  </form>`;
}

function Importing({able}) {
  const chosen = useRef();
  const [take, busy, problem] = useAction(async () => {
    const [file] = chosen.current.files;
    if (!file) return;
    // A type that the service does not know is refused by it, in words.
    const type = TYPES[file.name.split(".").at(-1).toLowerCase()] ?? "text/plain";
    const made = await ask("POST", `/calibration/import?${new URLSearchParams({label: file.name.slice(0, 100)})}`, {file, headers: {"Content-Type": type}});
    location.hash = `#/calibrate/${made.id}`;
  });
  return html`<h3>From a file</h3>
    <div class="row"><label>A calibration of slrig's (.json) or OpenCV's (.yml, .xml)<input type="file" accept=".json,.yml,.yaml,.xml" ref=${chosen} disabled=${!able} onChange=${take} /></label></div>
    ${busy && html`<p class="quiet" role="status">It is being read …</p>`}
    <${Refusal} problem=${problem} />`;
}

/** One calibration. All of it is the service's: a page that is loaded anew goes on where it was. */
function Calibration({id, rig, looked, able, may}) {
  const [session, problem, again] = useValue(`/calibration/${id}`, 2);
  const [asking, setAsking] = useState(false);
  const [remove, removing, kept] = useAction(async () => {
    await ask("DELETE", `/calibration/${id}`);
    location.hash = "#/calibrate";
  });
  const back = html`<p><a href="#/calibrate">All calibrations</a></p>`;
  if (!session) return problem?.status ? html`<${Refusal} problem=${problem} />${back}` : html`<p class="wait">Asking the service …</p>`;
  const given = {session, rig, able, again};
  const solved = session.links.files["calibration.json"] && html`<${Solved} key="solved" looked=${looked} ...${given} />`;
  const shooting = !session.imported && html`<${Shooting} key="shooting" may=${may} ...${given} />`;
  return html`${back}
    <div class="between"><h2>${nameOf(session)}</h2><span><span class="quiet">${session.board?.title ?? "of a file, without poses"} </span><${States} of=${session} /></span></div>
    ${session.state === "solved" ? [solved, shooting] : [shooting, solved]}
    ${session.shot.length > 0 && html`<${Poses} ...${given} />`}
    <${Refusal} problem=${kept} />
    ${asking ? html`<${Confirm} question="Delete this calibration with all its poses? They cannot be brought back." yes="Delete" onYes=${remove} onNo=${() => setAsking(false)} />`
      : html`<p><${Action} disabled=${!able} busy=${removing} onClick=${() => setAsking(true)}>Delete this calibration<//></p>`}`;
}

/** What a solve gave: the verdict first, then whether scans use it, then figures and files. */
function Solved({session, rig, looked, able, again}) {
  const {result, links} = session;
  const {verdict} = result ?? {};
  const [kind, sign] = GRADES[verdict?.grade] ?? [];
  const [use, busy, refused] = useAction(async (what) => {
    await ask("POST", `${links.self}/${what}`);
    await Promise.all([again(), looked()]);
  });
  return html`<section class="box" aria-labelledby="verdict"><h2 id="verdict">${verdict ? "What the solve says" : "What the file holds"}</h2>
    ${session.state === "open" && verdict && html`<p class="warning">The poses were changed since. Solve again to have the new ones counted.</p>`}
    ${verdict && html`<p class=${`judged ${kind}`} role="status"><span aria-hidden="true">${sign} </span>${begun(verdict.summary)}.</p>`}
    <${Lines} of=${verdict?.reasons} />
    ${!session.active && html`<${Lines} words="Before scans use it:" of=${verdict?.unattended} />`}
    ${limited(session) && html`<${Measuring} key=${session.id} session=${session} able=${able} again=${again} />`}
    <div class="row">${session.active
      ? html`<${Action} key="stop" busy=${busy} disabled=${!able} onClick=${() => use("deactivate")}>Stop using it<//><span>In use. If you stop using it, scans fall back to the rig file's calibration, if there is one.</span>`
      : html`<${Action} key="use" kind="primary" busy=${busy} disabled=${!able} onClick=${() => use("activate")}>Use it<//><span>Scans use it from the next one on, after a restart too.</span>`}</div>
    <${Refusal} problem=${refused} />
    ${!session.active && rig?.calibration?.id && html`<${Comparing} key=${rig.calibration.id} active=${rig.calibration.id} id=${session.id} />`}
    ${result && html`<${Figures} result=${result} />`}
    <p class="row">${Object.entries(links.files).toReversed().map(([name, path]) => name === "report.html" ? html`<a href=${path} target="_blank" rel="noopener">Report with pictures</a>` : html`<a href=${path} download=${name}>${name}</a>`)}</p>
    <details hidden=${!verdict?.remarks.length}><summary>Remarks</summary><${Lines} of=${verdict?.remarks} /></details>
  </section>`;
}

/** Whether the size of a board that nobody measured is most of the error. */
const limited = ({board, result}) => board && !board.measured && 2 * result?.expected.board_mm ** 2 > result?.expected.point_mm ** 2;

function Measuring({session, able, again}) {
  const [across, setAcross] = useState("");
  const [down, setDown] = useState("");
  const [solve, busy, problem] = useAction(async () => {
    await ask("POST", session.links.solve, {body: {measured_mm: [Number(across), Number(down)]}});
    await again();
  });
  const submit = (event) => {
    event.preventDefault();
    solve();
  };
  const [below, beside] = session.board.rulers_mm;
  return html`<form class="box" onSubmit=${submit}>
    <p><strong>The board's size has not been measured</strong>, and is most of the error: ${length(session.result.expected.board_mm)}. Hold a steel ruler to the two printed scales, from the first to the last tick.</p>
    <div class="row numbers">
      <${Field} label=${`Scale below, printed ${below} mm`} value=${across} change=${setAcross} required />
      <${Field} label=${`Scale on the left, printed ${beside} mm`} value=${down} change=${setDown} required />
      <button class="action" type="submit" aria-busy=${busy} disabled=${busy || !able}>Solve with these</button>
    </div>
    <${Refusal} problem=${problem} /></form>`;
}

const Lines = ({words, of}) => of?.length > 0 && html`${words && html`<p>${words}</p>`}<ul>${of.map((each) => html`<li>${each}</li>`)}</ul>`;

function Comparing({active, id}) {
  const [found, setFound] = useState(null);
  const [compare, busy, problem] = useAction(async () => setFound(await ask("GET", `/calibration/compare?first=${active}&second=${id}`)));
  return html`<p><${Action} busy=${busy} onClick=${compare}>Compare with the one in use<//></p>
    <${Refusal} problem=${problem} /><${Lines} words="This one against the one in use:" of=${found?.words} />`;
}

const pixels = (value) => (value === null ? "too few poses" : `${value.toFixed(3)} px`);

function Figures({result}) {
  const {expected, odd_even: halves} = result;
  const [low, high] = expected.volume_mm;
  return html`<${Facts} of=${[
    [expected.across ? "A point may be off, across the line of sight (1 σ)" : "A point may be off (1 σ)", length(expected.point_mm)],
    ["… of that by the size of the board", expected.board_mm && length(expected.board_mm)],
    ["… with the noise of the light", expected.total_mm && length(expected.total_mm)],
    ["A length of 1 m", expected.length_share && length(1000 * expected.length_share)],
    ["Odd and even poses, solved apart", halves ? html`${halves.fits ? "agree" : html`<strong>disagree</strong>`}: ${length(halves.difference_mm)}, ${halves.ratio.toFixed(2)} × what is stated` : "too few poses to tell"],
    ["Board", result.board?.words.replace(/^the board /, "")],
    ["Where the board was held", `${high.map((most, at) => (most - low[at]).toFixed(0)).join(" × ")} mm`],
    ["Poses used", result.poses.length],
    ...Object.entries(result.outliers).map(([name, why]) => [`Left out: ${name}`, why]),
  ]} />
  <div class="wide" tabindex="0" role="region" aria-label="Residuals by device"><table><thead><tr><th scope="col">Residual (rms)</th><th scope="col">poses used</th><th scope="col">poses held out</th><th scope="col">noise alone</th></tr></thead>
    <tbody>${Object.entries(result.devices).map(([name, each]) => html`<tr><th scope="row">${name}</th><td>${pixels(each.rms_px)}</td><td>${pixels(each.held_out_rms_px)}</td><td>${pixels(each.stated_rms_px)}</td></tr>`)}</tbody></table></div>`;
}
