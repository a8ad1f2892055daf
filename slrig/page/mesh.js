// A mesh in the workspace: how it is coloured and drawn, its legend, what is measured on it, and the point that a picture beside it shows.
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";
import {useTold} from "./colours.js";
import {fetchMesh} from "./glb.js";
import {MeasureBar, Marks, Measured, useMeasuring} from "./measuring.js";
import {Action, Choice, Refusal, count, number, percent} from "./ui.js";
import {Panel, Workspace} from "./workspace.js";

const COLOURS = [
  ["shaded", "Shaded"], ["albedo", "Albedo"], ["depth", "Depth"], ["sigma", "σ"], ["stripe", "Stripe"], ["cause", "Cause"], ["views", "Views"], ["deviation", "Deviation"],
];
const FORMS = [["surface", "Surface"], ["points", "Points"], ["wires", "Wires"]];
const SIGMA_STEP_MM = 1e-4;
/** Of this scan and of the one beside it; told apart by the colour-blind, too. */
const PLAIN = ["#b9c2c8", "#e69f00"];
const TURN_DEG = 10;
/** A kind of which there is less is not in the legend. */
const LEAST_SHARE = 1e-4;
/** A pointer that rests for so long is asked what it points at. */
const REST_MS = 40;

/** The part that draws is large: whoever will need it has it loaded before there is something to draw. */
let drawing = null;
export const loadDrawing = () => {
  drawing ??= import("./view.js");
  return drawing;
};

// A page that is opened at a result loads it together with the session and the scan.
if (/^#\/(scan|models)\/./.test(location.hash)) loadDrawing().catch(() => {});

/**
 * `scan`: a scan, or a model of several, which is `merged` and has no stripes. `other`: a scan shown in the same view, or null. `report` and `calibration` may come later.
 * `again` takes the box of what is seen, or is null. `over` stands over the middle of the stage. `pointed`: {mm}, a point that is pointed at, or {fromMm, along}, the ray
 * of a picture's pixel; `point` takes one. `rescale`: see `Measured`. `head` and `children` stand beside the stage.
 */
export function Mesh({scan, other = null, report, calibration = null, again, over, pointed = null, point, rescale = null, head, children}) {
  const canvas = useRef();
  const [view, setView] = useState(null);
  const [styles, setStyles] = useState({});
  const [, setDrawn] = useState(0);
  const [problem, setProblem] = useState(null);
  const [wanted, setMode] = useState("shaded");
  const [form, setForm] = useState("surface");
  const [both, setShown] = useState([true, true]);
  useEffect(() => {
    let made = null;
    let left = false;
    loadDrawing().then(({View, SCALE_CSS, SIGNED_CSS, BACK_CSS}) => {
      if (left) return;
      made = new View(canvas.current, () => setDrawn((before) => before + 1));
      setStyles({scale: SCALE_CSS, signed: SIGNED_CSS, back: BACK_CSS});
      setView(made);
    }).catch(() => setProblem({document: {title: "No 3-D here"}, message: "The browser has no WebGL 2, or it is switched off. The files can be downloaded all the same."}));
    return () => {
      left = true;
      made?.dispose();
    };
  }, []);
  const [mine, meshes] = useLevels(view, 0, scan, setProblem);
  const [theirs, others] = useLevels(view, 1, other, setProblem);
  const told = useTold({scan, report, calibration, mesh: meshes.full ?? null, other: others.full ?? null, mode: wanted});
  const offered = COLOURS.filter(([name]) => told.offers(name));
  const mode = told.offers(wanted) ? wanted : "shaded";
  // Of the other scan these are not known, and it would hide this one.
  const alone = ["cause", "views", "deviation"].includes(mode);
  const shown = !other ? [true, true] : alone ? [true, false] : both;
  const range = useRange(mode, scan, report, meshes.coarse, told);
  useEffect(() => {
    if (told.values && view) view.tell(meshes.full, told.values);
  }, [view, told.values]);
  // Until its values are computed, a mode shows the shape.
  const drawn = alone && !told.values ? "shaded" : mode;
  useEffect(() => view?.set(drawn, form, range, told.kinds.map(({colour}) => colour), shown), [view, drawn, form, ...range, told.kinds, ...shown]);
  useEffect(() => view?.limit(scan.plan?.reconstruction?.region?.box_mm), [view, scan.id]);
  const measuring = useMeasuring(view, scan.unit);
  const ready = view !== null && meshes.full !== undefined;
  const take = (x, y) => measuring.take(view.pick(x, y));
  const looked = useRef();
  looked.current = measuring.on && ready ? take : null;
  useEffect(() => view?.clicks((x, y) => looked.current?.(x, y)), [view]);
  const resting = useRef();
  const rest = (event) => {
    clearTimeout(resting.current);
    const {offsetX: x, offsetY: y, buttons} = event;
    if (point && ready && buttons === 0) resting.current = setTimeout(() => point(hitOf(view.pick(x, y))), REST_MS);
  };
  const leave = () => {
    clearTimeout(resting.current);
    point?.(null);
  };
  useEffect(() => () => clearTimeout(resting.current), []);
  const [spot, setSpot] = useState(null);
  useEffect(() => setSpot(ready && pointed?.along ? view.seenFrom(pointed.fromMm, pointed.along)?.pointMm ?? null : null), [ready, pointed]);
  const swap = () => setShown((before) => before[0] && before[1] ? [true, false] : [before[1], before[0]]);
  const cameras = Object.entries(report?.cameras ?? {}).filter(([, camera]) => camera.rotation);
  const toggled = (name) => setForm(form === name ? "surface" : name);
  const keys = view ? [
    ["ArrowLeft", "Turn", () => view.turn(TURN_DEG, 0)], ["ArrowRight", "Turn", () => view.turn(-TURN_DEG, 0)], ["ArrowUp", "Turn", () => view.turn(0, TURN_DEG)],
    ["ArrowDown", "Turn", () => view.turn(0, -TURN_DEG)], ["+", "Nearer", () => view.closer(1.25)], ["-", "Further", () => view.closer(0.8)], ["f", "Fit to the window", () => view.fit()],
    ["r", "From the front", () => view.front()], ...cameras.map(([name, camera], at) => [`${at + 1}`, `From camera ${name}`, () => view.from(camera)]),
    ["c", "Next colours", () => setMode(offered[(offered.findIndex(([name]) => name === mode) + 1) % offered.length][0])],
    ["p", "Points, or the surface again", () => toggled("points")], ["w", "Wires, or the surface again", () => toggled("wires")], ["m", "Measure, or stop measuring", measuring.toggle],
    ["Enter", "Measure at the middle", () => measuring.on && ready && take(canvas.current.clientWidth / 2, canvas.current.clientHeight / 2)],
    ["Backspace", "Remove the last measurement", measuring.back], ["Escape", "Stop measuring", () => measuring.on && measuring.toggle()],
    ...other ? [["b", "One scan in place of the other", swap]] : [],
  ] : [];
  const stage = html`<canvas ref=${canvas} tabindex="0" role="application" aria-label="Mesh in 3-D" class=${measuring.on ? "aim" : ""} onPointerMove=${rest} onPointerLeave=${leave}></canvas>
    ${view && html`<${Marks} view=${view} measuring=${measuring} pointed=${spot} />`}
    ${measuring.on && html`<p class="next" role="status">${measuring.refused ?? `${measuring.next} Or turn it, and press Enter for the point in the middle.`}</p>`}
    ${over && html`<div class="over middle">${over}</div>`}
    ${problem && html`<div class="over middle"><${Refusal} problem=${problem} /></div>`}`;
  const top = html`<${Choice} label="Colours" value=${mode} options=${offered} chosen=${setMode} /><${Choice} label="Form" value=${form} options=${FORMS} chosen=${setForm} />`;
  const bottom = html`<div class="notes"><${Legend} mode=${mode} range=${range} axis=${report?.axis} styles=${styles} told=${told} other=${other} back=${form === "surface"} unit=${scan.unit} />
      <p role="status">${mine}${other && ` Other scan: ${theirs}`}${told.busy && ` ${told.busy}`}</p></div>
    <div class="bar">
      <${Action} aria-pressed=${measuring.on} disabled=${!ready} onClick=${measuring.toggle}>Measure<//>
      ${measuring.on ? html`<${MeasureBar} measuring=${measuring} />` : html`
      <${Action} disabled=${!view} onClick=${() => view.fit()}>Fit<//><${Action} disabled=${!view} onClick=${() => view.front()}>Front<//>
      ${cameras.map(([name, camera]) => html`<${Action} disabled=${!view} onClick=${() => view.from(camera)}>From ${name}<//>`)}
      ${other && !alone && html`<${Choice} label="Scans shown" value=${shown.join()} options=${[["true,true", "Both"], ["true,false", "This"], ["false,true", "Other"]]}
        chosen=${(value) => setShown(value.split(",").map((each) => each === "true"))} />`}
      ${again && html`<${Action} disabled=${!view} onClick=${() => again(view.seen())}>Limit the next scan to this view<//>`}`}
    </div>`;
  const measured = measuring.done.length > 0 && html`<${Panel} key="measured" name="Measurements"><${Measured} measuring=${measuring} rescale=${rescale} /><//>`;
  return html`<${Workspace} label="Mesh" stage=${stage} top=${top} bottom=${bottom} keys=${keys}>${children && html`${head}${measured}${children}`}<//>
    ${!children && measured}`;
}

const hitOf = (hit) => hit && {mm: hit.pointMm};

/** Show a scan's mesh in a slot of the view, coarse first. Returns how far it is, in words, and the meshes `coarse` and `full` that are here. */
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
      setWords("Loading the mesh …");
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
  return [words, meshes];
}

/** The ends of the values that are coloured: of σ and stripes as stored, of all others in mm. */
function useRange(mode, scan, report, coarse, told) {
  const sigma = scan.summary?.mesh?.sigma_mm;
  const [depth, setDepth] = useState([0, 1]);
  useEffect(() => {
    const {array = [], width = 1} = coarse?.attributes.POSITION ?? {};
    const z = Float64Array.from({length: array.length / width}, (_, vertex) => array[vertex * width + 2]).sort();
    if (z.length) setDepth([0.01, 0.99].map((share) => coarse.originMm[2] + coarse.stepMm * z[Math.round(share * (z.length - 1))]));
  }, [coarse]);
  const ranges = {
    sigma: sigma && [sigma.p5, sigma.p95].map((mm) => mm / SIGMA_STEP_MM), stripe: [0, report?.frames.projector_px[report.axis === "row" ? 1 : 0] ?? 1], depth, deviation: told.range,
  };
  const [least, most] = ranges[mode] ?? [0, 1];
  return most > least ? [least, most] : [least, least + 1];
}

const inUnit = (mm, unit = "mm") => `${number(mm)}\u00a0${unit}`;
const SCALES = {
  sigma: ["Standard deviation along the normal; the ends are the 5 % and 95 % of this scan.", (value, unit) => inUnit(value * SIGMA_STEP_MM, unit)],
  stripe: ["Projector line.", (value) => `${count(value)}\u00a0px`],
  depth: ["Depth, z of the scan's axes; nearer is less.", inUnit],
  deviation: ["Distance to the other scan; orange lies before it, blue behind.", inUnit],
};

function Legend({mode, range: [least, most], axis, styles, told, other, back, unit}) {
  if (SCALES[mode]) {
    const [words, written] = SCALES[mode];
    return html`<div class="scale"><p>${mode === "stripe" ? `Projector ${axis ?? "column"}.` : words} Grey: not known.</p>
      <div style=${{background: mode === "deviation" ? styles.signed : styles.scale}}></div>
      <div class="between">${[least, (least + most) / 2, most].map((value) => html`<span>${written(value, unit)}</span>`)}</div>${told.words && html`<p>${told.words}</p>`}</div>`;
  }
  const entries = mode === "cause" || mode === "views" ? told.kinds.filter(({share}) => share > LEAST_SHARE).sort((a, b) => b.share - a.share).map(({colour, words, share}) => [colour, `${words}, ${percent(share)}`])
    : mode === "shaded" ? [...other ? [[PLAIN[0], "this scan"], [PLAIN[1], "the other"]] : [], ...back ? [[styles.back, "back side"]] : []] : [];
  return html`<div class="scale">${told.chooser}${entries.map(([colour, words]) => html`<div class="legend"><span class="swatch" style=${{background: colour}}></span>${words}</div>`)}</div>`;
}
