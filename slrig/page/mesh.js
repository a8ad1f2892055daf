// The mesh view with what belongs to it: how it is coloured, its legend, the distances measured on it.
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";
import {fetchMesh} from "./glb.js";
import {Action, Choice, Refusal, count, length, percent} from "./ui.js";

const WORDS = [["shaded", "Shaded"], ["albedo", "Albedo"], ["sigma", "σ"], ["stripe", "Stripe"]];
const SIGMA_STEP_MM = 1e-4;
/** Of this scan and of the one beside it; told apart by the colour-blind, too. */
const PLAIN = ["#b9c2c8", "#e69f00"];
const TURN_DEG = 10;

/** The part that draws is large: whoever will need it has it loaded before there is something to draw. */
let drawing = null;
export const loadDrawing = () => {
  drawing ??= import("./view.js");
  return drawing;
};

/**
 * `scan`: a scan, or a model of several, which is `merged` and has no stripes. `other`: a scan shown in the same view, or null. `report` may come later.
 * `again` takes the box of what is seen, or is null.
 */
export function Mesh({scan, other, report, again}) {
  const canvas = useRef();
  const [view, setView] = useState(null);
  const [scale, setScale] = useState("");
  const [, setDrawn] = useState(0);
  const [problem, setProblem] = useState(null);
  const [mode, setMode] = useState("shaded");
  const [wanted, setShown] = useState([true, true]);
  const shown = other ? wanted : [true, true];
  const [measuring, setMeasuring] = useState(false);
  const [points, setPoints] = useState([]);
  useEffect(() => {
    let made = null;
    let left = false;
    loadDrawing().then(({View, SCALE_CSS}) => {
      if (left) return;
      made = new View(canvas.current, () => setDrawn((before) => before + 1));
      setScale(SCALE_CSS);
      setView(made);
    }).catch(() => setProblem({document: {title: "No 3-D here"}, message: "The browser has no WebGL 2, or it is switched off. The files can be downloaded all the same."}));
    return () => {
      left = true;
      made?.dispose();
    };
  }, []);
  const mine = useLevels(view, 0, scan, setProblem);
  const theirs = useLevels(view, 1, other, setProblem);
  const sigma = scan.summary?.mesh?.sigma_mm;
  const axis = report?.axis === "row" ? 1 : 0;
  const ranges = {sigma: sigma ? [sigma.p5, sigma.p95].map((mm) => mm / SIGMA_STEP_MM) : [0, 1], stripe: [0, report?.frames.projector_px[axis] ?? 1]};
  const range = ranges[mode] ?? [0, 1];
  useEffect(() => view?.set(mode, range[1] > range[0] ? range : [range[0], range[0] + 1], shown), [view, mode, ...range, ...shown]);
  useEffect(() => view?.limit(scan.plan?.reconstruction?.region?.box_mm), [view, scan.id]);
  const take = (x, y) => {
    const hit = view.pick(x, y);
    if (hit) setPoints((before) => [...before, hit]);
  };
  const looked = useRef();
  looked.current = measuring ? take : null;
  useEffect(() => view?.clicks((x, y) => looked.current?.(x, y)), [view]);
  const swap = () => setShown((before) => before[0] && before[1] ? [true, false] : [before[1], before[0]]);
  const keys = {
    ArrowLeft: () => view.turn(TURN_DEG, 0), ArrowRight: () => view.turn(-TURN_DEG, 0), ArrowUp: () => view.turn(0, TURN_DEG), ArrowDown: () => view.turn(0, -TURN_DEG),
    "+": () => view.closer(1.25), "-": () => view.closer(0.8), f: () => view.fit(), r: () => view.front(), b: () => other && swap(),
    Enter: () => measuring && take(canvas.current.clientWidth / 2, canvas.current.clientHeight / 2),
  };
  const pressed = (event) => {
    if (!view || event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  };
  const cameras = Object.entries(report?.cameras ?? {}).filter(([, told]) => told.rotation);
  const pairs = [];
  for (let at = 0; at + 1 < points.length; at += 2) pairs.push(points.slice(at, at + 2));
  return html`<${Refusal} problem=${problem} />
    <div class="row">
      <${Choice} label="Colours" value=${mode} options=${WORDS.filter(([name]) => name !== "stripe" || !scan.merged)} chosen=${setMode} />
      <${Action} aria-pressed=${measuring} disabled=${!view} onClick=${() => setMeasuring(!measuring)}>Measure<//>
      <${Action} disabled=${!view} onClick=${() => view.fit()}>Fit<//><${Action} disabled=${!view} onClick=${() => view.front()}>Front<//>
      ${cameras.map(([name, told]) => html`<${Action} disabled=${!view} onClick=${() => view.from(told)}>From ${name}<//>`)}
      ${other && html`<${Choice} label="Scans shown" value=${shown.join()} options=${[["true,true", "Both"], ["true,false", "This"], ["false,true", "Other"]]}
        chosen=${(value) => setShown(value.split(",").map((each) => each === "true"))} />`}
    </div>
    <div class="stage">
      <canvas ref=${canvas} tabindex="0" role="application" aria-label="Mesh in 3-D" aria-describedby="keys" class=${measuring ? "aim" : ""} onKeyDown=${pressed}></canvas>
      ${view && html`<${Marks} view=${view} points=${points} measuring=${measuring} />`}
    </div>
    <p class="quiet" role="status">${mine}${other && ` Other scan: ${theirs}`}</p>
    ${mode !== "shaded" && mode !== "albedo" && html`<${Legend} mode=${mode} range=${range} axis=${report?.axis} scale=${scale} />`}
    ${other && mode === "shaded" && html`<p class="legend"><span class="swatch" style=${{background: PLAIN[0]}}></span>this scan <span class="swatch" style=${{background: PLAIN[1]}}></span>the other; key B shows one in place of the other</p>`}
    ${measuring && html`<p>${points.length % 2 ? "Now the second point." : "Choose the first point: click on the mesh, or turn it and press Enter for the point in the middle."}</p>`}
    ${pairs.length > 0 && html`<${Distances} pairs=${pairs} cleared=${() => setPoints([])} />`}
    ${again && html`<${Action} disabled=${!view} onClick=${() => again(view.seen())}>Scan only what is seen here<//>`}
    <p class="quiet" id="keys">Drag turns, two fingers or the right button move, the wheel zooms. Keys: arrows turn, + and − zoom, F fits, R is the front.</p>`;
}

/** Show a scan's mesh in a slot of the view, coarse first. Returns how far it is, in words. */
function useLevels(view, slot, scan, setProblem) {
  const [words, setWords] = useState("");
  const [meshes, setMeshes] = useState({});
  useEffect(() => {
    view?.hold(slot, meshes, PLAIN[slot]);
  }, [view, meshes]);
  useEffect(() => {
    if (!scan) return undefined;
    const ending = new AbortController();
    const load = async () => {
      setWords("The picture comes.");
      for (const [level, path] of [["coarse", "coarse.glb"], ["full", "view.glb"]]) {
        const mesh = await fetchMesh(`${scan.links.self}/${path}`, ending.signal, (share) => level === "full" && setWords(`A coarse picture; ${percent(Math.round(20 * share) / 20)} of the whole is here.`));
        setMeshes((before) => ({...before, [level]: mesh}));
        if (level === "full") setWords(`${count(mesh.triangles)} triangles.`);
      }
    };
    load().catch((problem) => {
      if (!ending.signal.aborted) setProblem(problem);
    });
    return () => {
      ending.abort();
      setMeshes({});
    };
  }, [scan?.id]);
  return words;
}

/** Above the picture: points, lines between two of them, a bar of a round length. */
function Marks({view, points, measuring}) {
  const placed = points.map((each) => view.place(each.pointMm));
  const most = 120 * view.mmPerPx;
  const power = 10 ** Math.floor(Math.log10(most));
  const bar = [5, 2, 1].map((each) => each * power).find((each) => each <= most);
  const {clientHeight: height, clientWidth: width} = view.canvas;
  return html`<svg aria-hidden="true">
    ${placed.map(([x, y], at) => html`<circle cx=${x} cy=${y} r="5" />${at % 2 === 1 && html`<line x1=${placed[at - 1][0]} y1=${placed[at - 1][1]} x2=${x} y2=${y} />
      <text x=${x + 8} y=${y - 8}>${(at + 1) / 2}</text>`}`)}
    ${measuring && html`<path d=${`M${width / 2 - 8} ${height / 2}h16M${width / 2} ${height / 2 - 8}v16`} />`}
    ${bar && html`<path d=${`M16 ${height - 22}v6h${bar / view.mmPerPx}v-6`} /><text x="20" y=${height - 22}>${length(bar)}</text>`}
  </svg>`;
}

function Legend({mode, range, axis, scale}) {
  const written = mode === "sigma" ? (value) => length(value * SIGMA_STEP_MM) : (value) => `${Math.round(value)} px`;
  return html`<div class="scale"><p>${mode === "sigma" ? "Standard deviation along the normal; the ends are the 5 % and 95 % of this scan" : `Projector ${axis ?? "column"}`}. Grey: not known.</p>
    <div style=${{background: scale}}></div>
    <div class="between">${[range[0], (range[0] + range[1]) / 2, range[1]].map((value) => html`<span>${written(value)}</span>`)}</div></div>`;
}

function Distances({pairs, cleared}) {
  const at = ({pointMm}) => pointMm.map((mm) => mm.toFixed(3)).join(", ");
  return html`<div class="wide"><table class="distances"><caption>Distances</caption>
      <thead><tr><th>No.</th><th>Distance</th><th>σ</th><th>From, to (x, y, z in mm)</th></tr></thead>
      <tbody>${pairs.map(([a, b], number) => html`<tr><td>${number + 1}</td><td>${Math.hypot(...a.pointMm.map((mm, axis) => mm - b.pointMm[axis])).toFixed(3)} mm</td>
        <td>${length(Math.hypot(a.sigmaMm, b.sigmaMm))}</td><td>${at(a)}<br />${at(b)}</td></tr>`)}</tbody></table></div>
    <p class="quiet">σ joins those of the two points, as if each lay along the line. It holds noise, and the calibration's error where that is stated. Not in it: where you clicked, and what both points share, such as a wrong scale.</p>
    <${Action} onClick=${cleared}>Clear<//>`;
}
