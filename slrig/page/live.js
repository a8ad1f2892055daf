// The live picture of a camera: there at once while somebody looks and the rig is free, with what it says of light and focus.
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";
import {LiveDepth} from "./depth.js";
import {Opening, holderWords} from "./ready.js";
import {Choice} from "./ui.js";

const KEPT = "live";
const OFF = "";
const AGAIN_MS = 3000;
/** So long without a key or a pointer nobody looks: the projector would be lit all night. */
const AWAY_MS = 10 * 60 * 1000;

/** Whether somebody looks at this page: its tab is to be seen, and a hand has moved within some minutes. */
function useLooking() {
  const [looking, setLooking] = useState(!document.hidden);
  useEffect(() => {
    let moved = Date.now();
    const look = () => setLooking(!document.hidden && Date.now() - moved < AWAY_MS);
    const move = () => {
      moved = Date.now();
      look();
    };
    const kinds = ["pointermove", "pointerdown", "keydown", "visibilitychange"];
    kinds.forEach((kind) => document.addEventListener(kind, move));
    const timer = setInterval(look, 1000);
    return () => {
      kinds.forEach((kind) => document.removeEventListener(kind, move));
      clearInterval(timer);
    };
  }, []);
  return looking;
}

/**
 * What a camera sees while nobody scans. `aim`: where a board goes next, as a calibration says it. `plain`: nothing is
 * marked. `exposure_s`: of the picture; null is the rig file's. `told(figures)` is called each second with what the picture says, see `measured`, and
 * with null when it is over. `limits`: of live depth, as a request has them. `ghost`: by camera, a picture that lies over the live one, half-transparent.
 */
export function Live({rig, may, aim, ghost, plain = false, exposure_s = null, limits = {}, told}) {
  const [chosen, setChosen] = useState(() => sessionStorage.getItem(KEPT));
  const [light, setLight] = useState("white");
  const [view, setView] = useState("picture");
  const [failed, setFailed] = useState(false);
  const running = useRef(null);
  const looking = useLooking();
  const names = rig?.cameras.map((each) => each.name) ?? [];
  const camera = chosen === OFF ? null : [chosen, aim?.camera, names[0]].find((name) => names.includes(name)) ?? null;
  const stream = camera && `/preview/${encodeURIComponent(camera)}?${new URLSearchParams({light, marks: String(!plain), ...(exposure_s ? {exposure_s} : {})})}`;
  useEffect(() => {
    if (!failed) return undefined;
    const timer = setTimeout(() => setFailed(false), AGAIN_MS);
    return () => clearTimeout(timer);
  }, [failed]);
  if (!may("scan")) return html`<p class="live none">A key with the scope “scan” shows the live picture.</p>`;
  const absent = !rig ? "Asking the service …" : rig.error ? `No picture comes: ${rig.error}` : !rig.open ? html`<${Opening} rig=${rig} />`
    : camera === null ? "The live picture is off." : !looking ? "Paused, because nobody looks. Move the pointer to go on."
      : failed ? "No picture comes. It is tried again by itself." : rig.holder && running.current !== stream ? `${holderWords(rig)} The picture comes when it is free.` : null;
  const {size_px} = rig?.cameras.find((each) => each.name === camera) ?? {};
  // Only where nothing else is aimed at: a board is placed by what the camera sees.
  const offered = !plain && aim === undefined && rig?.calibrated;
  const inDepth = offered && view === "depth" && camera && looking && rig.open && !rig.error;
  const aimed = !absent && aim?.camera === camera && aim?.outline_px?.length ? aim : null;
  const choose = (name) => {
    sessionStorage.setItem(KEPT, name);
    setChosen(name);
    setFailed(false);
  };
  return html`
    ${inDepth ? html`<${LiveDepth} key=${camera} camera=${camera} size_px=${size_px} options=${{...limits, ...(exposure_s ? {exposure_s} : {})}} />`
      : absent ? html`<div class="live none" role=${failed ? "alert" : null}>${absent}</div>`
      : html`<div class="aimed"><${Picture} key=${stream} stream=${stream} camera=${camera} running=${running} told=${told} failed=${() => setFailed(true)} />
        ${ghost?.[camera] && html`<img class="ghost" src=${ghost[camera]} alt="The last view, half-transparent" />`}
        ${aimed && html`<${Aim} aim=${aimed} size_px=${size_px} />`}</div>`}
    <div class="row">
      ${names.length > 0 && html`<${Choice} label="Camera" value=${camera ?? OFF} options=${[...names.map((name) => [name, name]), [OFF, "Off"]]} chosen=${choose} />`}
      ${offered && camera && html`<${Choice} label="View" value=${view} options=${[["picture", "Picture"], ["depth", "Depth"]]} chosen=${setView} />`}
      ${camera && !absent && !inDepth && html`<${Choice} label="Projector" value=${light} options=${[["white", "White light"], ["off", "Dark"]]} chosen=${setLight} />`}
      ${inDepth && html`<span class="legend"><span><span class="swatch moved"></span> moved</span><span><span class="swatch saturated"></span> saturated</span><span>black: no depth</span></span>`}
      ${!absent && !inDepth && html`<span class="legend">${aimed && html`<span><span class="swatch aim"></span> The board goes here, its upper left corner to the dot.</span>`}
        ${!plain && html`<span><span class="swatch saturated"></span> saturated</span>`}${!plain && light === "white" && html`<span><span class="swatch dark"></span> too dark</span>`}${rig.holder && html`<span>Waits while the rig is in use.</span>`}</span>`}
    </div>`;
}

function Picture({stream, camera, running, told, failed}) {
  const image = useRef();
  useEffect(() => {
    const shown = image.current;
    running.current = stream;
    const timer = setInterval(() => {
      const found = measured(shown);
      if (found) told?.({camera, ...found});
    }, 1000);
    // A picture that is no more shown would go on loading, and the projector would stay lit.
    return () => {
      clearInterval(timer);
      running.current = null;
      told?.(null);
      shown.removeAttribute("src");
    };
  }, []);
  return html`<img class="live" ref=${image} src=${stream} alt=${`Live picture of camera ${camera}`} onError=${failed} />`;
}

const middle = (points) => [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);

/** The outline that the board is to fill, and an arrow to it from where the board was shot last. */
function Aim({aim, size_px}) {
  const [width, height] = size_px;
  const unit = width / 100;
  const outline = aim.outline_px;
  const to = middle(outline);
  const from = aim.from_px ?? null;
  const way = from && Math.hypot(to[0] - from[0], to[1] - from[1]);
  const along = way && [0, 1].map((axis) => (to[axis] - from[axis]) / way);
  const at = (back, aside) => [to[0] - along[0] * back - along[1] * aside, to[1] - along[1] * back + along[0] * aside].join(",");
  return html`<svg viewBox=${`0 0 ${width} ${height}`} aria-hidden="true">
    <polygon points=${outline.join(" ")} /><circle cx=${outline[0][0]} cy=${outline[0][1]} r=${1.7 * unit} />
    ${way > 5 * unit && html`<path d=${`M${from.join(",")}L${at(3 * unit, 0)}`} /><path class="head" d=${`M${to.join(",")}L${at(5 * unit, 2.5 * unit)}L${at(5 * unit, -2.5 * unit)}Z`} />`}
  </svg>`;
}

export const LEVELS = 64;
const WIDE_PX = 240;
/** The middle of the picture as it came, in which fine detail tells the focus. */
const SHARP_PX = 256;

/**
 * What a marked picture says: shares of its pixels that are saturated (red) and too dark (blue), `levels` of brightness
 * (shares, from dark to bright), and `sharpness`, the contrast from pixel to pixel in its middle. null before there is one.
 */
function measured(image) {
  if (!image.naturalWidth) return null;
  const {naturalWidth: width, naturalHeight: height} = image;
  const part = Math.min(SHARP_PX, width, height);
  const whole = pixelsOf(image, [0, 0, width, height], WIDE_PX, Math.max(1, Math.round((WIDE_PX * height) / width)));
  const near = pixelsOf(image, [(width - part) / 2, (height - part) / 2, part, part], part, part);
  const levels = new Array(LEVELS).fill(0);
  let saturated = 0;
  let dark = 0;
  for (let at = 0; at < whole.length; at += 4) {
    const [red, green, blue] = [whole[at], whole[at + 1], whole[at + 2]];
    const burnt = red > green + 80;
    const unlit = !burnt && blue > green + 60;
    saturated += burnt;
    dark += unlit;
    levels[burnt ? LEVELS - 1 : unlit ? 0 : Math.floor((green * LEVELS) / 256)] += 1;
  }
  const count = whole.length / 4;
  return {saturated: saturated / count, dark: dark / count, levels: levels.map((each) => each / count), sharpness: sharpness(near, part)};
}

function pixelsOf(image, from, width, height) {
  const canvas = Object.assign(document.createElement("canvas"), {width, height});
  const context = canvas.getContext("2d", {willReadFrequently: true});
  context.imageSmoothingEnabled = false;
  context.drawImage(image, ...from, 0, 0, width, height);
  return context.getImageData(0, 0, width, height).data;
}

/** Mean difference of the next pixel but one, over the mean brightness: large where edges are sharp, whatever the exposure. */
function sharpness(pixels, size) {
  let differences = 0;
  let light = 1;
  for (let row = 0; row < size - 2; row += 1) {
    for (let column = 0; column < size - 2; column += 1) {
      const at = 4 * (row * size + column) + 1;
      differences += (pixels[at + 8] - pixels[at]) ** 2 + (pixels[at + 8 * size] - pixels[at]) ** 2;
      light += pixels[at] ** 2;
    }
  }
  return Math.sqrt(differences / light);
}
