// A camera's picture, and why each of its pixels gave no point.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {count, percent} from "./ui.js";

/** `told`: the camera's part of the report; `causes`: the report's words for each value of the map of causes. */
export function Causes({camera, told, causes, files}) {
  const [shown, setShown] = useState(false);
  const [at, setAt] = useState(null);
  const map = useCauses(shown ? files[`causes-${camera}.png`] : null);
  const picture = files[`rejected-${camera}.png`];
  if (!picture || !causes || !told.rejected_png_px) return null;
  const follow = (event) => {
    const box = event.currentTarget.getBoundingClientRect();
    setShown(true);
    setAt([(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]);
  };
  const refused = causes.map(({name, ...rest}) => [name === "none" ? told.measured_pixels ?? told.decoded_pixels : told.refused_pixels[name] ?? 0, rest]).filter(([pixels]) => pixels > 0);
  const all = refused.reduce((sum, [pixels]) => sum + pixels, 0);
  const [width, height] = told.rejected_png_px;
  return html`<section aria-label=${`Causes, camera ${camera}`}>
    <h2>What camera ${camera} saw, and why pixels are missing</h2>
    <div class="two">
      <div>
        <div class="causes" style=${{aspectRatio: `${width} / ${height}`}} onPointerMove=${follow} onPointerDown=${follow} onPointerLeave=${() => setAt(null)}>
          <${Cut} picture=${picture} width=${width} camera=${camera} />
        </div>
        <p class="told">${at ? (map ? sentence(map, causes, at) : "Reading the causes …") : html`<span class="quiet">Point at a pixel, to be told why it gave no point.</span>`}</p>
      </div>
      <div class="wide"><table><thead><tr><th>Pixels</th><th>Share</th><th>Why</th></tr></thead>
        <tbody>${refused.map(([pixels, {words, colour}]) => html`<tr><td>${count(pixels)}</td><td>${percent(pixels / all)}</td>
          <td><span class="swatch" style=${{background: colour}}></span> ${words}</td></tr>`)}</tbody></table></div>
    </div>
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

/** The map of causes: {width, height, codes}, a byte for each pixel; null before it is there. */
function useCauses(path) {
  const [map, setMap] = useState(null);
  useEffect(() => {
    if (!path) return;
    let left = false;
    const read = async () => {
      // Values, not colours: nothing may be converted on the way.
      const image = await createImageBitmap(await (await fetch(path)).blob(), {colorSpaceConversion: "none"});
      const {width, height} = image;
      const context = new OffscreenCanvas(width, height).getContext("2d", {willReadFrequently: true});
      context.drawImage(image, 0, 0);
      const {data} = context.getImageData(0, 0, width, height);
      const codes = new Uint8Array(width * height);
      for (let pixel = 0; pixel < codes.length; pixel += 1) codes[pixel] = data[4 * pixel];
      if (!left) setMap({width, height, codes});
    };
    read().catch(() => {});
    return () => {
      left = true;
    };
  }, [path]);
  return map;
}
