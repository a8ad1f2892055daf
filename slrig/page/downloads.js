// Download: the files of a scan or a model in groups by what they are for, one that is made first with a sign of work.
import {ask} from "./service.js";
import {Refusal, bytes} from "./ui.js";
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";

/** [form of the name, what it is for, group, whether it is made only when it is asked for]; the first that fits counts. */
const FILES = [
  [/^mesh\.stl$/, "CAD and printing, in mm", "CAD", true], [/^mesh\.3mf$/, "printing, in mm, with colours", "CAD", true], [/^mesh\.obj$/, "modelling programs, in mm", "CAD", true],
  [/^(mesh|model)\.glb$/, "viewers and web pages, in metres", "CAD"],
  [/^points\.ply$/, "points before meshing", "Point clouds"], [/^placed\.ply$/, "all views in one frame, not merged", "Point clouds"],
  [/^points-.*\.e57$/, "a point for each pixel, E57", "Point clouds", true], [/^points-.*\.pcd$/, "a point for each pixel, PCL", "Point clouds", true],
  [/^(mesh|model)\.ply$/, "mesh in mm, with σ for each vertex", "Programs"], [/^points-.*\.npz$/, "a point for each pixel, numpy", "Programs", true],
  [/^depth-/, "depth of each pixel, 16 bits", "Programs", true], [/^scan\.mcap$/, "a bag for ROS 2 and Foxglove, in metres", "Programs", true],
  [/^report\.json$/, "all figures", "Programs"], [/^poses\.json$/, "where each view belongs", "Programs"],
  [/^bundle\.zip$/, "frames and calibration, to reconstruct again", "Raw", true], [/^calibration\.json$/, "lenses and poses of the devices", "Raw"],
  [/^(preview|sides)\.png$/, "a picture to send", "More"], [/^rejected-/, "why pixels gave no point, a picture", "More"], [/^causes-/, "the same as numbers", "More"],
  [/^agreement-/, "how far columns and rows disagree", "More"], [/^view\.glb$/, "what this page shows", "More", true], [/^coarse\.glb$/, "what this page shows first", "More", true],
];
const GROUPS = ["CAD", "Point clouds", "Programs", "Raw", "More"];
const MARGIN_PX = 8;
const LONGEST_PAUSE_S = 10;

/** [group, [{name, path, purpose, later}, …]] of `files`, a path by each name; groups without a file are left out. */
export function grouped(files) {
  const known = Object.entries(files).map(([name, path]) => {
    const at = FILES.findIndex(([form]) => form.test(name));
    const [, purpose = "", group = "More", later = false] = FILES[at] ?? [];
    return {name, path, purpose, group, later, at: at < 0 ? FILES.length : at};
  });
  known.sort((one, other) => one.at - other.at);
  return GROUPS.map((group) => [group, known.filter((each) => each.group === group)]).filter(([, all]) => all.length > 0);
}

/** Have the service make what is at a path, however long that takes, and return its size in bytes, if that is known. Throws Problem. */
async function made(path) {
  for (;;) {
    const answer = await fetch(path, {method: "HEAD"}).catch(() => null);
    if (answer?.ok) return Number(answer.headers.get("Content-Length")) || null;
    const pause_s = answer?.status === 503 && Number(answer.headers.get("Retry-After"));
    // What a refusal says is in the answer to GET.
    if (!pause_s) return ask("GET", path).then(() => null);
    await new Promise((resolve) => setTimeout(resolve, 1000 * Math.min(pause_s, LONGEST_PAUSE_S)));
  }
}

/** Save what is made at a path, by the name that the service gives it: [save, path under way, seconds so far, problem, sizes]. */
export function useSaving() {
  const [state, setState] = useState({path: null, problem: null});
  const [sizes, setSizes] = useState({});
  const [seconds, setSeconds] = useState(0);
  useEffect(() => {
    setSeconds(0);
    if (!state.path) return undefined;
    const timer = setInterval(() => setSeconds((before) => before + 1), 1000);
    return () => clearInterval(timer);
  }, [state.path]);
  const save = async (path) => {
    setState({path, problem: null});
    try {
      const size = await made(path);
      if (size) setSizes((before) => ({...before, [path]: size}));
      const link = document.createElement("a");
      Object.assign(link, {href: path, download: ""});
      link.click();
      setState({path: null, problem: null});
    } catch (problem) {
      setState({path: null, problem});
    }
  };
  return [save, state.path, seconds, state.problem, sizes];
}

/** The button *Download* with its menu. `files`: a path by each name. */
export function Downloads({files}) {
  const [known, setKnown] = useState({});
  const [save, busy, seconds, problem, sizes] = useSaving();
  const button = useRef(null);
  const menu = useRef(null);
  const groups = grouped(files);
  const toggled = ({newState}) => {
    if (newState !== "open") return;
    const {left, bottom} = button.current.getBoundingClientRect();
    const most = innerWidth - menu.current.offsetWidth - MARGIN_PX;
    Object.assign(menu.current.style, {left: `${Math.max(Math.min(left, most), MARGIN_PX)}px`, top: `${bottom + MARGIN_PX}px`, maxHeight: `${innerHeight - bottom - 3 * MARGIN_PX}px`});
    for (const {name, path} of groups.flatMap(([, all]) => all).filter(({name, later}) => !later && !known[name]))
      fetch(path, {method: "HEAD"}).then((answer) => {
        const size = Number(answer.headers.get("Content-Length"));
        if (answer.ok && size) setKnown((before) => ({...before, [name]: size}));
      }, () => {});
  };
  const row = ({name, path, purpose, later}) => {
    const size = sizes[path] ?? known[name];
    const waits = busy === path;
    const clicked = (event) => {
      if (!later) return;
      event.preventDefault();
      if (!busy) save(path);
    };
    return html`<li><a href=${path} download="" aria-busy=${waits} onClick=${clicked}>${name}</a> <span class="quiet">${purpose}</span>
      <span class="quiet">${waits ? "" : size ? bytes(size) : later ? "made first" : ""}</span>
      ${waits && html`<span class="making" role="status">Making it … ${seconds > 2 ? `${seconds} s` : ""}</span>`}</li>`;
  };
  const list = ([group, all]) => group === "More"
    ? html`<details><summary>More</summary><ul>${all.map(row)}</ul></details>`
    : html`<h3>${group}</h3><ul>${all.map(row)}</ul>`;
  return html`<button ref=${button} type="button" class="action primary" popovertarget="downloads" aria-haspopup="true" aria-busy=${Boolean(busy)}>Download</button>
    <div ref=${menu} id="downloads" class="downloads" popover="auto" role="group" aria-label="Files" onToggle=${toggled}>
      ${groups.map(list)}
      <${Refusal} problem=${problem} />
    </div>`;
}
