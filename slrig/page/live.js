// The live picture of a camera, and what it says of the exposure.
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";
import {Action, Choice, percent} from "./ui.js";

/** What a camera sees while nobody scans. Looking takes the rig between scans, so it is asked for, never begun by itself. Without `setBracket` nothing is said of the exposure. `aim`: where a board goes next, as a calibration says it. */
export function Live({rig, may, bracket, setBracket, aim}) {
  const [camera, setCamera] = useState(null);
  const [light, setLight] = useState("white");
  const [failed, setFailed] = useState(false);
  const image = useRef();
  const names = rig?.cameras.map((each) => each.name) ?? [];
  const seen = camera !== null && names.includes(camera) ? camera : null;
  if (!may("scan")) return html`<p class="quiet">A key for scans shows the live picture.</p>`;
  const {size_px} = rig?.cameras.find((each) => each.name === seen) ?? {};
  const outline = aim?.camera === seen && aim?.outline_px.length ? aim.outline_px : null;
  return html`
    <div class="row">
      <${Choice} label="Camera" value=${seen} options=${[[null, "Off"], ...names.map((name) => [name, name])]} chosen=${(name) => { setCamera(name); setFailed(false); }} />
      ${seen && html`<${Choice} label="Projector" value=${light} options=${[["white", "White light"], ["off", "Dark"]]} chosen=${setLight} />`}
    </div>
    ${!seen && html`<p class="live none">Choose a camera to see what it sees.</p>`}
    ${seen && failed && html`<p class="live none" role="alert">No picture comes. ${rig.error ?? "Choose the camera again to try once more."}</p>`}
    ${seen && !failed && html`<div class="aimed"><${Picture} key=${`${seen} ${light}`} image=${image} camera=${seen} light=${light} failed=${() => setFailed(true)} />
        ${outline && html`<svg viewBox=${`0 0 ${size_px.join(" ")}`} aria-hidden="true"><polygon points=${outline.join(" ")} /><circle cx=${outline[0][0]} cy=${outline[0][1]} r=${size_px[0] / 60} /></svg>`}</div>
      <p class="legend">${outline && html`<span><span class="swatch aim"></span> the board goes here, its upper left corner to the dot</span>`}<span class="swatch saturated"></span>saturated <span class="swatch dark"></span>too dark ${rig.holder && " · waits while the rig is held"}</p>
      ${light === "white" && setBracket && html`<${Exposure} image=${image} camera=${rig.cameras.find((each) => each.name === seen)} bracket=${bracket} setBracket=${setBracket} />`}`}`;
}

function Picture({image, camera, light, failed}) {
  // A picture that is no more shown would go on loading, and the projector would stay lit.
  useEffect(() => {
    const shown = image.current;
    return () => shown.removeAttribute("src");
  }, []);
  return html`<img class="live" ref=${image} src=${`/preview/${encodeURIComponent(camera)}?light=${light}&marks=true`}
    alt=${`Live picture of camera ${camera}`} onError=${failed} />`;
}

/** Of the picture: less is a highlight or two. */
const LEAST_SATURATED = 0.002;
/** Two exposures this many times apart share two thirds of the range of 8 bits. */
const STEP = 4;

/** What the marks in the live picture say of the exposure, and a bracket where one exposure cannot do. */
function Exposure({image, camera, bracket, setBracket}) {
  const [shares, setShares] = useState(null);
  useEffect(() => {
    const timer = setInterval(() => setShares(marked(image.current)), 1000);
    return () => clearInterval(timer);
  }, [camera.name]);
  if (!shares) return null;
  const now_s = camera.exposure_s;
  const shorter_s = now_s / STEP;
  const proposed = shares.saturated > LEAST_SATURATED && shorter_s >= camera.exposure_range_s[0] ? [shorter_s, now_s] : null;
  return html`<p>${percent(shares.saturated)} saturated, ${percent(shares.dark)} too dark or in shadow${now_s ? `, at ${milliseconds(now_s)}` : ""}.
    ${!bracket && proposed && html` <${Action} onClick=${() => setBracket(proposed)}>Scan with ${proposed.map(milliseconds).join(" and ")}<//>`}
    ${bracket && html` Each scan takes ${bracket.map(milliseconds).join(" and ")}. <${Action} onClick=${() => setBracket(null)}>One exposure again<//>`}</p>`;
}

const milliseconds = (seconds) => `${Number((1000 * seconds).toPrecision(3))} ms`;

/** Shares of a picture's pixels that are marked as saturated (red) and as too dark (blue); null before there is one. */
function marked(image) {
  if (!image?.naturalWidth) return null;
  const canvas = document.createElement("canvas");
  canvas.width = 240;
  canvas.height = Math.max(1, Math.round((240 * image.naturalHeight) / image.naturalWidth));
  const context = canvas.getContext("2d", {willReadFrequently: true});
  context.imageSmoothingEnabled = false;
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  const {data} = context.getImageData(0, 0, canvas.width, canvas.height);
  let saturated = 0;
  let dark = 0;
  for (let at = 0; at < data.length; at += 4) {
    if (data[at] > data[at + 1] + 80) saturated += 1;
    if (data[at + 2] > data[at + 1] + 60) dark += 1;
  }
  return {saturated: (4 * saturated) / data.length, dark: (4 * dark) / data.length};
}
