// All scans: found by name, state and day, shown by days, and chosen to be downloaded together, made one model of, or deleted.
import {useSaving} from "./downloads.js";
import {called} from "./names.js";
import {ask, once, useAction} from "./service.js";
import {Action, Confirm, JobBadge, Refusal, count, length} from "./ui.js";
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";

const PAGE = 48;
const MOST_ANEW = 200;
const LOOK_AGAIN_MS = 5000;
const MOST_TOGETHER = 50;
const KEPT = "slrig-scans";
const STATES = {"": "Any state", succeeded: "Succeeded", "failed interrupted": "Failed", cancelled: "Cancelled", "queued capturing computing": "Under way"};
const SPANS = {"": "Any day", today: "Today", week: "This week", last: "Last week", month: "Last 30 days", days: "Choose days"};
const FORMATS = {"mesh.stl": "STL", "mesh.ply": "PLY", "mesh.glb": "GLB", "mesh.3mf": "3MF", "mesh.obj": "OBJ", "points.ply": "Points", "report.json": "Report"};
const isOver = (scan) => !["queued", "capturing", "computing"].includes(scan.state);
const NOTHING = {name: "", state: "", span: "", from: "", to: ""};

/** Midnight here, `days` after that of a moment. */
const midnight = (moment, days = 0) => new Date(moment.getFullYear(), moment.getMonth(), moment.getDate() + days);

/** [since, until] of a choice of days, each a Date or null. Weeks begin on Monday. `from`, `to`: as 2026-11-30, both included. */
export function span({span: chosen, from, to}, now) {
  const monday = midnight(now, -((now.getDay() + 6) % 7));
  const day = (text, days) => (text ? midnight(new Date(`${text}T12:00`), days) : null);
  return {today: [midnight(now), null], week: [monday, null], last: [midnight(monday, -7), monday], month: [midnight(now, -30), null], days: [day(from, 0), day(to, 1)]}[chosen] ?? [null, null];
}

/** The address of what is asked for. */
export function address(asked, now) {
  const [since, until] = span(asked, now);
  const query = new URLSearchParams({limit: PAGE});
  if (asked.name.trim()) query.set("name", asked.name.trim());
  for (const state of asked.state.split(" ").filter(Boolean)) query.append("state", state);
  if (since) query.set("since", since.toISOString());
  if (until) query.set("until", until.toISOString());
  return `/scan?${query}`;
}

/** [words, scans] of each day, from new to old as the scans are. */
export function days(scans, now) {
  const groups = new Map();
  for (const scan of scans) {
    const day = midnight(new Date(scan.created_at)).getTime();
    if (!groups.has(day)) groups.set(day, []);
    groups.get(day).push(scan);
  }
  const words = (day) => {
    if (day === midnight(now).getTime()) return "Today";
    if (day === midnight(now, -1).getTime()) return "Yesterday";
    const date = new Date(day);
    return date.toLocaleDateString("en-GB", {weekday: "long", day: "numeric", month: "long", ...(date.getFullYear() === now.getFullYear() ? {} : {year: "numeric"})});
  };
  return [...groups].map(([day, all]) => [words(day), all]);
}

/** Scans page after page: what is shown is asked for again as long as the page is looked at. */
function useScans(path) {
  const [found, setFound] = useState({path: null, scans: [], next: null, problem: null});
  const [loading, setLoading] = useState(false);
  const shown = useRef(0);
  const wanted = useRef(path);
  wanted.current = path;
  const current = found.path === path ? found : {path: null, scans: [], next: null, problem: found.path === null ? found.problem : null};
  shown.current = current.scans.length;
  const again = async () => {
    const limit = Math.min(Math.max(shown.current, PAGE), MOST_ANEW);
    try {
      const page = await ask("GET", path.replace(/limit=\d+/, `limit=${limit}`));
      if (wanted.current !== path) return;
      setFound((before) => {
        const older = before.path === path && before.scans.length > page.scans.length && page.next ? before.scans.slice(before.scans.findIndex(({id}) => id === page.scans.at(-1).id) + 1) : [];
        return {path, scans: [...page.scans, ...older.filter(({id}) => !page.scans.some((each) => each.id === id))], next: older.length ? before.next : page.next, problem: null};
      });
    } catch (problem) {
      if (wanted.current === path) setFound((before) => ({...(before.path === path ? before : {path: null, scans: [], next: null}), problem}));
    }
  };
  const more = async () => {
    if (loading || !current.next) return;
    setLoading(true);
    try {
      const page = await ask("GET", current.next);
      if (wanted.current === path) setFound((before) => ({...before, scans: [...before.scans, ...page.scans.filter(({id}) => !before.scans.some((each) => each.id === id))], next: page.next, problem: null}));
    } catch (problem) {
      setFound((before) => ({...before, problem}));
    }
    setLoading(false);
  };
  useEffect(() => {
    let timer = 0;
    let over = false;
    const turn = async () => {
      if (!document.hidden) await again();
      if (!over) timer = setTimeout(turn, LOOK_AGAIN_MS);
    };
    turn();
    return () => {
      over = true;
      clearTimeout(timer);
    };
  }, [path]);
  return [current.path === path ? current.scans : null, current.problem, again, current.next && more, loading];
}

const kept = () => {
  try {
    return {...NOTHING, ...JSON.parse(sessionStorage.getItem(KEPT))};
  } catch {
    return NOTHING;
  }
};

export function ScansScreen({may}) {
  const [asked, setAsked] = useState(kept);
  const [name, setName] = useState(asked.name);
  const change = (more) => setAsked((before) => {
    const next = {...before, ...more};
    sessionStorage.setItem(KEPT, JSON.stringify(next));
    return next;
  });
  useEffect(() => {
    const timer = setTimeout(() => change({name}), 250);
    return () => clearTimeout(timer);
  }, [name]);
  const now = new Date();
  const [scans, problem, again, more, loading] = useScans(address(asked, now));
  const [chosen, setChosen] = useState([]);
  const [last, setLast] = useState(null);
  const list = useRef(null);
  const all = scans ?? [];
  const taken = all.filter(({id}) => chosen.includes(id));
  const toggle = (id, range) => {
    const ids = all.map((each) => each.id);
    const [first, end] = [ids.indexOf(last), ids.indexOf(id)].sort((one, other) => one - other);
    const meant = range && first >= 0 ? ids.slice(first, end + 1) : [id];
    setChosen((before) => before.includes(id) ? before.filter((each) => !meant.includes(each)) : [...new Set([...before, ...meant])]);
    setLast(id);
  };
  const pressed = (event) => {
    const links = [...list.current.querySelectorAll("a.card")];
    const at = links.indexOf(event.target);
    if (event.key === "Escape") setChosen([]);
    if (at < 0) return;
    const columns = links.filter((each) => each.offsetTop === links[at].offsetTop).length;
    const step = {ArrowLeft: -1, ArrowRight: 1, ArrowUp: -columns, ArrowDown: columns}[event.key];
    if (step) links[Math.min(Math.max(at + step, 0), links.length - 1)].focus();
    if (event.key === " ") toggle(event.target.dataset.id, event.shiftKey);
    if (step || event.key === " ") event.preventDefault();
  };
  const clear = () => {
    setName("");
    change(NOTHING);
  };
  const filtered = Object.keys(NOTHING).some((each) => asked[each]);
  const select = (label, key, options) => html`<label>${label} <select value=${asked[key]} onChange=${(event) => change({[key]: event.target.value})}>
    ${Object.entries(options).map(([value, words]) => html`<option value=${value}>${words}</option>`)}</select></label>`;
  return html`<p><a href="#/scan">Scan</a></p><h2>All scans</h2>
    <div class="row" role="search" aria-label="Find scans">
      <label>Name <input type="search" value=${name} placeholder="part of a name" onInput=${(event) => setName(event.target.value)} /></label>
      ${select("State", "state", STATES)}${select("Day", "span", SPANS)}
      ${asked.span === "days" && ["from", "to"].map((end) => html`<label>${end === "from" ? "From" : "To"} <input type="date" value=${asked[end]} onInput=${(event) => change({[end]: event.target.value})} /></label>`)}
      ${filtered && all.length > 0 && html`<${Action} onClick=${clear}>Show all<//>`}
    </div>
    ${taken.length > 0 && html`<${Chosen} scans=${taken} may=${may} again=${again} clear=${() => setChosen([])} />`}
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${!scans && !problem && html`<p class="wait" role="status">Asking for the scans …</p>`}
    ${scans?.length === 0 && (filtered ? html`<p>No scan matches. <${Action} onClick=${clear}>Show all<//></p>` : html`<p>No scans yet. <a href="#/scan">Make the first</a></p>`)}
    <div ref=${list} onKeyDown=${pressed}>
      ${days(all, now).map(([words, group]) => html`<section key=${words} aria-label=${words}><h3>${words} <span class="quiet">${group.length}</span></h3>
        <ul class="cards many">${group.map((scan) => html`<${Card} key=${scan.id} scan=${scan} chosen=${chosen.includes(scan.id)} toggle=${toggle} />`)}</ul></section>`)}
    </div>
    ${more && html`<${More} more=${more} busy=${loading} />`}`;
}

/** Shows older ones as soon as it comes into view, or is pressed. */
function More({more, busy}) {
  const end = useRef(null);
  const latest = useRef(more);
  latest.current = more;
  useEffect(() => {
    if (busy) return undefined;
    const observer = new IntersectionObserver(([{isIntersecting}]) => isIntersecting && latest.current(), {rootMargin: "400px"});
    observer.observe(end.current);
    return () => observer.disconnect();
  }, [busy]);
  return html`<p ref=${end}><${Action} busy=${busy} onClick=${more}>Show older scans<//></p>`;
}

function Card({scan, chosen, toggle}) {
  const {picture} = scan.links;
  const time = new Date(scan.created_at).toLocaleTimeString("en-GB", {timeStyle: "short"});
  return html`<li class="pickable" aria-current=${chosen ? "true" : null}>
    <label class="pick-one"><input type="checkbox" checked=${chosen} aria-label=${`Select ${called(scan)}`} onClick=${(event) => toggle(scan.id, event.shiftKey)} /></label>
    <a class="card" data-id=${scan.id} href=${`#/scan/${scan.id}`}>
      ${picture ? html`<img src=${picture} alt="" loading="lazy" width="320" height="240" />` : html`<span class="none" aria-hidden="true">No picture</span>`}
      <span class="between"><span class="name">${scan.label ?? time}</span>${scan.state !== "succeeded" && html`<${JobBadge} state=${scan.state} />`}</span>
      <span class="quiet">${[scan.label ? time : null, scan.triangles === null ? null : `${count(scan.triangles)} triangles, σ ${length(scan.sigma_mm, scan.unit)}`, scan.preset, scan.pinned ? "pinned" : null].filter(Boolean).join(" · ")}</span>
      ${scan.error && html`<span class="quiet clip">${scan.error.detail}</span>`}
    </a></li>`;
}

/** What can be done with the scans that are selected. */
function Chosen({scans, may, again, clear}) {
  const [format, setFormat] = useState("mesh.stl");
  const [sure, setSure] = useState(false);
  const [save, saving, seconds, unsaved] = useSaving();
  const meshes = scans.filter(({state, triangles}) => state === "succeeded" && triangles !== null);
  const [join, joining, unjoined] = useAction(async () => {
    const inOrder = [...meshes].sort((one, other) => one.created_at.localeCompare(other.created_at));
    const poses = inOrder.every(({turn_deg}) => turn_deg !== null) ? {} : {poses: "unknown"};
    const model = await ask("POST", "/model", {body: {scans: inOrder.map(({id}) => id), ...poses}, headers: once()});
    location.hash = `#/models/${model.id}`;
  });
  const zip = `/scan/files.zip?${new URLSearchParams([["file", format], ...meshes.map(({id}) => ["scan", id])])}`;
  const words = scans.length === 1 ? "1 scan selected" : `${scans.length} scans selected`;
  return html`<div class="box chosen" role="region" aria-label="Selected scans">
    <div class="row">
      <strong role="status">${words}</strong><${Action} kind="plain" onClick=${clear}>Select none<//>
      <label>File <select value=${format} onChange=${(event) => setFormat(event.target.value)}>${Object.entries(FORMATS).map(([name, title]) => html`<option value=${name}>${title}</option>`)}</select></label>
      <${Action} kind="primary" busy=${Boolean(saving)} disabled=${meshes.length === 0 || meshes.length > MOST_TOGETHER} onClick=${() => save(zip)}>Download ${meshes.length} as zip<//>
      ${may("scan") && html`<${Action} busy=${joining} disabled=${meshes.length < 2} onClick=${join}>Make one model<//>
      <${Action} disabled=${sure} onClick=${() => setSure(true)}>Delete …<//>`}
    </div>
    ${saving && html`<p class="making" role="status">Making the files … ${seconds > 2 ? `${seconds} s` : ""}</p>`}
    ${meshes.length > MOST_TOGETHER && html`<p class="quiet">At most ${MOST_TOGETHER} scans come in one zip.</p>`}
    ${meshes.length < scans.length && html`<p class="quiet">${scans.length - meshes.length} without a mesh: left out of zip and model.</p>`}
    ${sure && html`<${Deletion} scans=${scans} again=${again} over=${() => setSure(false)} />`}
    <${Refusal} problem=${unsaved ?? unjoined} />
  </div>`;
}

/** Asks, then deletes one after the other; what is pinned or under way stays, and what was refused is told. */
function Deletion({scans, again, over}) {
  const [list] = useState(() => scans.filter((scan) => isOver(scan) && !scan.pinned));
  const [stays] = useState(() => scans.length - list.length);
  const [state, setState] = useState({done: null, refused: []});
  const stop = useRef(false);
  useEffect(() => () => {
    stop.current = true;
  }, []);
  const names = list.map((scan) => called(scan)).join(", ");
  const left = stays > 0 && html`<p>${stays === 1 ? "One that is" : `${stays} that are`} pinned or under way ${stays === 1 ? "stays" : "stay"}.</p>`;
  const remove = async () => {
    const refused = [];
    for (const [at, scan] of list.entries()) {
      if (stop.current) break;
      setState({done: at, refused});
      await ask("DELETE", scan.links.self).catch((problem) => problem.status === 404 || refused.push(`${called(scan)}: ${problem.message}`));
    }
    await again();
    if (refused.length) setState({done: list.length, refused});
    else over();
  };
  if (list.length === 0) return html`<div class="refusal" role="alert"><strong>Nothing to delete</strong>${left}<${Action} onClick=${over}>Close<//></div>`;
  if (state.done === null)
    return html`<${Confirm} question=${`Delete ${list.length === 1 ? "this scan" : `these ${list.length} scans`} with all files? Nothing brings them back: ${names}.`} yes=${list.length === 1 ? "Delete it" : `Delete ${list.length} scans`} onYes=${remove} onNo=${over} />${left}`;
  if (state.done < list.length)
    return html`<p role="status">Deleting ${state.done + 1} of ${list.length} …</p><${Action} onClick=${() => {
      stop.current = true;
    }}>Stop<//>`;
  return html`<${Refusal} problem=${{document: {title: `${state.refused.length} not deleted`}, message: state.refused.join(" ")}} /><${Action} onClick=${over}>Close<//>`;
}
