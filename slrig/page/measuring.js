// Measuring in the view: what is chosen, what is clicked, and the figures at the line and in a table.
import {html, useState} from "./vendor/preact-htm.js";
import {distance, fit, patch, pointToPlane, radius, scaleBy, section} from "./measure.js";
import {useAction} from "./service.js";
import {Action, Choice, Field, Refusal, count, length, number} from "./ui.js";

const KINDS = [["distance", "Distance"], ["plane", "Point to plane"], ["sphere", "Sphere"], ["cylinder", "Cylinder"], ["section", "Section"]];
const TOLD = Object.fromEntries(KINDS);
/** What to click, one after the other. */
const CLICKS = {
  distance: ["Click the first point.", "Now the second point."], plane: ["Click the plane.", "Now the point."], sphere: ["Click the ball."], cylinder: ["Click the cylinder."],
  section: ["Click where the section begins.", "Now where it ends."],
};
const FITTED = ["plane", "sphere", "cylinder"];
/** A patch's usual radius, over that of all that is there. */
const USUAL_PATCH = 0.06;

/** As many digits as its standard deviation lets one read. */
const digits = (mm, sigmaMm, unit) => `${number(mm, {decimals: sigmaMm > 0 ? Math.min(Math.max(-Math.floor(Math.log10(sigmaMm / 3)), 1), 4) : 3})}\u00a0${unit}`;
const figure = ({kind, valueMm, sigmaMm}, unit) => `${["sphere", "cylinder"].includes(kind) ? "radius " : ""}${digits(valueMm, sigmaMm, unit)}, σ ${length(sigmaMm, unit)}`;

/** All that measuring needs to know, and what changes it. `unit`: of the mesh's lengths, which are called mm here. */
export function useMeasuring(view, unit = "mm") {
  const [on, setOn] = useState(false);
  const [kind, setKind] = useState("distance");
  const [typed, setTyped] = useState(null);
  const [picks, setPicks] = useState([]);
  const [done, setDone] = useState([]);
  const [refused, setRefused] = useState(null);
  const usual = view ? Number((USUAL_PATCH * view.box.radius).toPrecision(1)) : 1;
  const patchMm = Number(typed ?? usual) || usual;
  const choose = (next) => {
    setKind(next);
    setPicks([]);
    setRefused(null);
  };
  const take = (seen) => {
    if (!seen) return;
    // A click is right to a pixel.
    const hit = {...seen, clickedMm: 1 / view.pxPerMm(seen.pointMm)};
    const pick = FITTED.includes(kind) && picks.length === 0 ? {...hit, patchMm, form: fit(kind, patch(hit.mesh, hit.pointMm, patchMm))} : hit;
    if (pick.form === null) {
      setRefused(`Too little surface within ${length(patchMm, unit)} of that point to fit a ${kind}. Choose a larger patch, or click elsewhere.`);
      return;
    }
    setRefused(null);
    const chosen = [...picks, pick];
    if (chosen.length < CLICKS[kind].length) {
      setPicks(chosen);
      return;
    }
    setPicks([]);
    const found = resultOf(kind, chosen);
    if (found) setDone((before) => [...before, {kind, picks: chosen, ...found}]);
    else setRefused("The surface has a gap between the two points, or they lie on two scans. Choose points on one piece of surface.");
  };
  return {
    on, kind, unit, patchMm, typed, setTyped, picks, done, refused, choose, take,
    toggle: () => {
      setOn(!on);
      setPicks([]);
      setRefused(null);
    },
    back: () => picks.length ? setPicks([]) : setDone((before) => before.slice(0, -1)),
    clear: () => {
      setPicks([]);
      setDone([]);
    },
    next: CLICKS[kind][picks.length],
  };
}

function resultOf(kind, [first, second]) {
  if (kind === "distance") return distance(first, second);
  if (kind === "plane") return pointToPlane(second, first.form);
  if (kind === "section") return first.mesh === second.mesh ? section(first.mesh, first, second, second.along) : null;
  return radius(first.form);
}

/** What is measured, the patch that is fitted, and how to take back. */
export function MeasureBar({measuring: {kind, unit, choose, typed, patchMm, setTyped, done, back, clear}}) {
  return html`<${Choice} label="Measure what" value=${kind} options=${KINDS} chosen=${choose} />
    ${FITTED.includes(kind) && html`<${Field} label=${`Patch radius, ${unit}`} value=${typed ?? patchMm} change=${setTyped} />`}
    ${done.length > 0 && html`<${Action} onClick=${back}>Remove the last<//><${Action} onClick=${clear}>Clear<//>`}`;
}

/** Over the picture: points, patches, lines with their figures, the point that a picture beside points at, and a bar of a round length. */
export function Marks({view, measuring, pointed}) {
  const place = (point) => view.place(point);
  const most = 120 * view.mmPerPx;
  const power = 10 ** Math.floor(Math.log10(most));
  const bar = [5, 2, 1].map((each) => each * power).find((each) => each <= most);
  const {clientHeight: height, clientWidth: width} = view.canvas;
  const marked = [...measuring.done, {picks: measuring.picks}];
  return html`<svg aria-hidden="true">
    ${marked.map(({kind, picks, ...found}) => html`
      ${picks.map(({pointMm, patchMm}) => html`<${Dot} at=${place(pointMm)} />${patchMm && html`<circle class="patch" ...${centred(place(pointMm))} r=${patchMm * view.pxPerMm(pointMm)} />`}`)}
      ${kind && html`<${Line} points=${lineOf(kind, picks, found).map(place)} /><${Words} at=${place(anchorOf(kind, picks, found))} words=${figure({kind, ...found}, measuring.unit)} />`}
      ${kind === "sphere" && html`<circle class="patch" ...${centred(place(picks[0].form.centre))} r=${picks[0].form.radius * view.pxPerMm(picks[0].form.centre)} />`}`)}
    ${pointed && html`<circle class="pointed" ...${centred(place(pointed))} r="9" />`}
    ${measuring.on && html`<path d=${`M${width / 2 - 8} ${height / 2}h16M${width / 2} ${height / 2 - 8}v16`} />`}
    ${bar && html`<path d=${`M16 ${height - 70}v6h${bar / view.mmPerPx}v-6`} /><text x="20" y=${height - 74}>${length(bar, measuring.unit)}</text>`}
  </svg>`;
}

const centred = ([cx, cy]) => ({cx, cy});
const Dot = ({at}) => html`<circle ...${centred(at)} r="4" />`;
const Line = ({points}) => html`<polyline points=${points.map((point) => point.join()).join(" ")} />`;
const Words = ({at: [x, y], words}) => html`<text x=${x + 10} y=${y - 10}>${words}</text>`;

/** The line in mm that a figure stands at. */
function lineOf(kind, picks, {line, footMm}) {
  if (kind === "section") return line;
  if (kind === "plane") return [picks[1].pointMm, footMm];
  if (kind === "distance") return picks.map(({pointMm}) => pointMm);
  const {form, patchMm} = picks[0];
  return kind === "cylinder" ? [-1, 1].map((way) => form.centre.map((each, axis) => each + way * patchMm * form.axis[axis])) : [];
}

function anchorOf(kind, picks, found) {
  const line = lineOf(kind, picks, found);
  if (FITTED.includes(kind)) return picks.at(-1).pointMm;
  const middle = line.length >> 1;
  return line.length > 2 ? line[middle] : line[0].map((mm, axis) => (mm + line[1][axis]) / 2);
}

/** `rescale` makes the scan again by a known length: by a factor and its relative σ; null where that cannot be. */
export function Measured({measuring: {done, unit, clear}, rescale}) {
  const at = ({pointMm}) => `(${pointMm.map((mm) => number(mm, {decimals: 3})).join(", ")})`;
  return html`<table class="measured"><thead><tr><th>What</th><th>Value</th><th>σ</th></tr></thead>
      <tbody>${done.map(({kind, picks, valueMm, sigmaMm}) => html`<tr><td>${TOLD[kind]}</td><td>${digits(valueMm, sigmaMm, unit)}</td><td>${length(sigmaMm, unit)}</td></tr>
        <tr class="quiet"><td colspan="3">${picks.map(at).join(" to ")} ${unit}${picks[0].form && `; fit of ${count(picks[0].form.points)} points, rms ${length(picks[0].form.rmsMm, unit)}`}
          ${rescale && kind === "distance" && html`<${KnownLength} found=${{valueMm, sigmaMm, clickedMm: picks.map(({clickedMm}) => clickedMm)}} rescale=${rescale} />`}</td></tr>`)}</tbody></table>
    <p class="quiet">σ comes from that of the mesh: noise, and the calibration's error where that is stated. A fitted patch counts as 16 independent points, because neighbours err alike.
      Not in it: where you clicked, and what all points share, such as a wrong scale.</p>
    <${Action} onClick=${clear}>Clear<//>`;
}

/** Says how long a measured distance is in truth. */
function KnownLength({found, rescale}) {
  const [trueMm, setTrue] = useState("");
  const [trueSigmaMm, setSigma] = useState("");
  const [compute, busy, problem] = useAction(() => rescale(scaleBy(found, Number(trueMm), Number(trueSigmaMm))));
  const submit = (event) => {
    event.preventDefault();
    compute();
  };
  return html`<details><summary>This length is known</summary><form onSubmit=${submit}>
    <div class="row numbers"><${Field} label="True length, mm" value=${trueMm} change=${setTrue} required /><${Field} label="Right within, mm" value=${trueSigmaMm} change=${setSigma} placeholder="0" /></div>
    <button class="action" type="submit" aria-busy=${busy} disabled=${busy || !(trueMm > 0)}>Compute again with this length</button></form>
    <${Refusal} problem=${problem} /></details>`;
}
