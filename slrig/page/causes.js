// A camera's picture, and why each of its pixels gave no point.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {project, rayOf} from "./projection.js";
import {count, percent} from "./ui.js";

/**
 * `told`: the camera's part of the report; `causes`: the report's words for each value of the map of causes. `device`: the camera in the scan's calibration, null before
 * it is here. `pointed` and `point`: as `Mesh` has them.
 */
export function Causes({camera, told, causes, files, device, pointed, point}) {
  const [shown, setShown] = useState(false);
  const [at, setAt] = useState(null);
  const [map, setMap] = useState(null);
  const path = files[`causes-${camera}.png`];
  const linked = device && pointed?.mm ? project(device, pointed.mm) : null;
  useEffect(() => {
    if (path && (shown || linked)) readCauses(path).then(setMap, () => {});
  }, [path, shown || Boolean(linked)]);
  const picture = files[`rejected-${camera}.png`];
  if (!picture || !causes || !told.rejected_png_px) return null;
  const follow = (event) => {
    const box = event.currentTarget.getBoundingClientRect();
    const place = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    setShown(true);
    setAt(place);
    if (device) point(rayOf(device, place.map((share, axis) => share * device.size_px[axis] - 0.5)));
  };
  const leave = () => {
    setAt(null);
    point(null);
  };
  const refused = causes.map(({name, ...rest}) => [name === "none" ? told.measured_pixels ?? told.decoded_pixels : told.refused_pixels[name] ?? 0, rest]).filter(([pixels]) => pixels > 0)
    .sort(([a], [b]) => b - a);
  const all = refused.reduce((sum, [pixels]) => sum + pixels, 0);
  const [width, height] = told.rejected_png_px;
  const place = at ?? linked?.slice(0, 2).map((pixel, axis) => (pixel + 0.5) / device.size_px[axis]);
  const inside = place && place.every((share) => share >= 0 && share < 1);
  return html`<section aria-label=${`Causes, camera ${camera}`}>
    <div class="causes" style=${{aspectRatio: `${width} / ${height}`}} onPointerMove=${follow} onPointerDown=${follow} onPointerLeave=${leave}>
      <${Cut} picture=${picture} width=${width} camera=${camera} />
      ${inside && !at && html`<svg aria-hidden="true"><circle cx=${`${100 * place[0]}%`} cy=${`${100 * place[1]}%`} r="8" /></svg>`}
    </div>
    <p class="told">${inside ? (map ? sentence(map, causes, place) : "Reading the causes …") : linked ? html`<span class="quiet">Camera ${camera} does not see that point.</span>`
      : html`<span class="quiet">Hover over a pixel to see why it was rejected, or over the mesh to find it here.</span>`}</p>
    <table class="shares"><thead><tr><th>Why</th><th>Share</th></tr></thead>
      <tbody>${refused.map(([pixels, {words, colour}]) => html`<tr title=${`${count(pixels)} pixels`}><td><span class="swatch" style=${{background: colour}}></span> ${words}</td><td>${percent(pixels / all)}</td></tr>`)}</tbody></table>
  </section>`;
}

/** The camera's part of the picture: it stands in the left upper corner, before the legend. */
function Cut({picture, width, camera}) {
  const [whole, setWhole] = useState(null);
  return html`<img src=${picture} alt=${`Camera ${camera}: what was measured is grey, the rest is coloured by cause`} draggable=${false}
    style=${{width: `${(100 * (whole ?? width)) / width}%`}} onLoad=${(event) => setWhole(event.target.naturalWidth)} />`;
}

function sentence({width, height, codes}, causes, [x, y]) {
  const column = Math.min(Math.max(Math.floor(x * width), 0), width - 1);
  const row = Math.min(Math.max(Math.floor(y * height), 0), height - 1);
  const {name, words} = causes[codes[row * width + column]] ?? {name: "", words: "not known"};
  return `Column ${column}, row ${row}: ${name === "none" ? "" : "refused: "}${words}.`;
}

const MOST_MAPS = 8;
const maps = new Map();

/** The map of causes: {width, height, codes}, a byte for each pixel. Read once. */
export function readCauses(path) {
  const read = async () => {
    // Values, not colours: nothing may be converted on the way.
    const image = await createImageBitmap(await (await fetch(path)).blob(), {colorSpaceConversion: "none"});
    const {width, height} = image;
    const context = new OffscreenCanvas(width, height).getContext("2d", {willReadFrequently: true});
    context.drawImage(image, 0, 0);
    const {data} = context.getImageData(0, 0, width, height);
    return {width, height, codes: Uint8Array.from({length: width * height}, (_, pixel) => data[4 * pixel])};
  };
  if (!maps.has(path)) {
    if (maps.size >= MOST_MAPS) maps.clear();
    maps.set(path, read().catch((error) => {
      maps.delete(path);
      throw error;
    }));
  }
  return maps.get(path);
}
