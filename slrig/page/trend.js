// Trend: figures of the last verifications over time, drawn for the theme and the width of the window.
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";
import {number} from "./ui.js";

const LEFT = 52, RIGHT = 12, TOP = 12, HEIGHT = 150, BELOW = 24;

/** A round step that gives an axis from 0 to `most` four parts at most. */
function round(most) {
  const size = 10 ** Math.floor(Math.log10(most / 4));
  return [1, 2, 2.5, 5, 10].map((factor) => factor * size).find((step) => 4 * step >= most * 0.999);
}

/**
 * One figure over time. `points`: [{at, value, kind, words}], from old to new; `kind` is a colour of the page (good, warn, bad).
 * `limits`: [[value, words, kind]]; those far above all points are left out.
 */
export function Trend({title, points, limits}) {
  const frame = useRef(null);
  const [width, setWidth] = useState(600);
  useEffect(() => {
    const watch = new ResizeObserver(([entry]) => setWidth(Math.max(entry.contentRect.width, 240)));
    watch.observe(frame.current);
    return () => watch.disconnect();
  }, []);
  const highest = Math.max(...points.map(({value}) => value));
  const near = limits.filter(([value]) => value <= 4 * highest);
  const most = Math.max(highest, ...near.map(([value]) => value), 1e-3) * 1.08;
  const step = round(most);
  const [first, last] = [points[0].at, points.at(-1).at];
  const x = (at) => LEFT + (width - LEFT - RIGHT) * (last > first ? (at - first) / (last - first) : 0.5);
  const y = (value) => TOP + HEIGHT * (1 - value / most);
  const day = (at) => at.toLocaleString("en-GB", last - first > 172.8e6 ? {day: "numeric", month: "short"} : {hour: "2-digit", minute: "2-digit"});
  return html`<figure class="chart" ref=${frame}><figcaption>${title}</figcaption>
    <svg viewBox=${`0 0 ${width} ${TOP + HEIGHT + BELOW}`} role="img" aria-label=${`${title}: ${points.length} verifications, the last ${number(points.at(-1).value)}. The table below has the figures.`}>
      ${Array.from({length: Math.floor(most / step) + 1}, (_, at) => html`<path class="grid" d=${`M${LEFT} ${y(at * step)}H${width - RIGHT}`} /><text x=${LEFT - 6} y=${y(at * step) + 4} text-anchor="end">${number(at * step)}</text>`)}
      ${near.map(([value, words, kind]) => html`<path class=${`limit ${kind}`} d=${`M${LEFT} ${y(value)}H${width - RIGHT}`} /><text class=${kind} x=${LEFT + 4} y=${y(value) - 4}>${words}</text>`)}
      <path class="line" d=${`M${points.map(({at, value}) => `${x(at).toFixed(1)} ${y(value).toFixed(1)}`).join("L")}`} />
      ${points.map(({at, value, kind, words}) => html`<circle class=${kind} cx=${x(at)} cy=${y(value)} r="4"><title>${day(at)}: ${number(value)}. ${words}</title></circle>`)}
      <text x=${x(first)} y=${TOP + HEIGHT + 18} text-anchor=${last > first ? "start" : "middle"}>${day(first)}</text>
      ${last > first && html`<text x=${x(last)} y=${TOP + HEIGHT + 18} text-anchor="end">${day(last)}</text>`}
    </svg></figure>`;
}
