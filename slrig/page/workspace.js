// The workspace: a dark stage that fills the window, bars over it, panels beside it that fold, full screen, and the keys that there are.
import {Action} from "./ui.js";
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";

const FOLDED = "folded";
const KEPT = "panels";

/**
 * `stage`: what fills it; `top`, `bottom`: what stands over it, at its upper and lower edge; `keys`: a list of [key, what it does in words, what is done], which work
 * while no field has the focus; `children`: panels, or null.
 */
export function Workspace({label, stage, top, bottom, keys = [], children}) {
  const whole = useRef();
  const help = useRef();
  const [folded, setFolded] = useState(() => localStorage.getItem(FOLDED) === "true");
  const fold = () => {
    localStorage.setItem(FOLDED, String(!folded));
    setFolded(!folded);
  };
  const fill = () => document.fullscreenElement ? document.exitFullscreen() : whole.current.requestFullscreen();
  const tell = () => help.current.open ? help.current.close() : help.current.showModal();
  const all = [...keys, ...children ? [["t", "Fold or unfold the panels", fold]] : [],
    ...document.fullscreenEnabled ? [["x", "Full screen, and back", fill]] : [], ["?", "Show these keys", tell]];
  const pressed = useRef();
  pressed.current = (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, select, textarea")) return;
    // Arrows scroll a panel, and Enter presses a button, unless the stage itself has the focus.
    const aimed = event.target.closest("canvas, body") === event.target;
    const found = all.find(([key]) => key === event.key && (aimed || key.length === 1));
    if (!found) return;
    event.preventDefault();
    found[2]();
  };
  useEffect(() => {
    const heard = (event) => pressed.current(event);
    addEventListener("keydown", heard);
    return () => removeEventListener("keydown", heard);
  }, []);
  return html`<div class=${`workspace ${children && !folded ? "beside" : ""}`}>
    <section class="stage" aria-label=${label} ref=${whole}>
      ${stage}
      <div class="over top">
        <div class="bar">${top}</div>
        <div class="bar ends">
          ${children && html`<${Action} aria-expanded=${!folded} onClick=${fold}>Panels<//>`}
          ${document.fullscreenEnabled && html`<${Action} onClick=${fill}>Full screen<//>`}<${Action} aria-label="Keys" onClick=${tell}>?<//>
        </div>
      </div>
      <div class="over bottom">${bottom}</div>
      <dialog ref=${help} aria-label="Keys" class="box">
        <h3>Keys</h3>
        <dl class="facts">${[...new Set(all.map(([, words]) => words))].map((words) => html`<div>
          <dt>${all.filter(([, each]) => each === words).map(([key]) => html`<kbd>${NAMES[key] ?? (key.length > 1 ? key : key.toUpperCase())}</kbd> `)}</dt><dd>${words}</dd></div>`)}</dl>
        <p class="quiet">Drag turns, two fingers or the right button move, the wheel zooms.</p>
        <${Action} onClick=${tell}>Close<//>
      </dialog>
    </section>
    ${children && !folded && html`<aside aria-label="Panels">${children}</aside>`}
  </div>`;
}

const NAMES = {ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓", "-": "−", Escape: "Esc"};

/** A part of the side that folds; the browser keeps which ones are open, and what was never opened is not made. */
export function Panel({name, open = true, children}) {
  const kept = () => JSON.parse(localStorage.getItem(KEPT) ?? "{}");
  const [shown, setShown] = useState(() => kept()[name] ?? open);
  const [made, setMade] = useState(shown);
  const toggled = (event) => {
    localStorage.setItem(KEPT, JSON.stringify({...kept(), [name]: event.currentTarget.open}));
    setShown(event.currentTarget.open);
    setMade(true);
  };
  return html`<details class="panel" open=${shown} onToggle=${toggled}><summary><h3>${name}</h3></summary>${made && children}</details>`;
}
