// Live depth while somebody aims: shape, depth and the camera's picture side by side, and what they say of the aim.
import {html, useEffect, useRef, useState} from "./vendor/preact-htm.js";
import {BufferAttribute, BufferGeometry, DoubleSide, Mesh, PerspectiveCamera, Scene, ShaderMaterial, WebGLRenderer} from "three";
import {ask} from "./service.js";
import {duration, length, number, percent} from "./ui.js";
import {OrbitControls} from "./vendor/OrbitControls.js";

const HEAD_BYTES = 8;
/** Pixels of the screen from point to point, and points along the longer side: more cost a browser's time, and no eye sees them. */
const APART = 2;
const [FEWEST, MOST] = [120, 480];
const AGAIN_MS = 2000;
const CHANGED_MS = 700;
const STARTING = "Starting live depth …";
const THEIRS = "Somebody else watches with other limits or another exposure: this is theirs.";
const FACTS_MS = 300;
const SHAPE_MS = 90;
/** A step in depth from point to point, over the distance, that is no surface. */
const STEP = 0.012;
const [MEASURED, MOVED, SATURATED, DARK, UNCLEAR] = [0, 1, 2, 3, 4];
const COLOURS = {[MOVED]: [255, 154, 31], [SATURATED]: [224, 32, 32], [DARK]: [22, 28, 46], [UNCLEAR]: [90, 90, 90]};

/** Live depth of a camera. `options`: what of the request is not as the rig has it. */
export function LiveDepth({camera, size_px, options}) {
  const [facts, setFacts] = useState(null);
  const [why, setWhy] = useState(STARTING);
  const [theirs, setTheirs] = useState(false);
  const shape = useRef();
  const depth = useRef();
  const grey = useRef();
  const view = useRef(null);
  const begun = useRef(false);
  // A canvas has one renderer for its life: a second one would find the context lost.
  useEffect(() => {
    view.current = shapeView(shape.current);
    return () => view.current?.dispose();
  }, []);
  useEffect(() => {
    const watching = new AbortController();
    const {signal} = watching;
    let told = 0;
    const shown = () => Math.max(...[shape, depth, grey].flatMap(({current: canvas}) => (canvas ? [canvas.clientWidth, canvas.clientHeight] : [0])));
    const show = (image) => {
      if (signal.aborted) return;
      setWhy(null);
      paint(depth.current, image, depthColour(image));
      paint(grey.current, image, (at) => [image.grey[at], image.grey[at], image.grey[at]]);
      view.current?.show(image);
      // For the bench: when the newest frame of what is drawn came.
      depth.current.dataset.came = image.facts.came_s;
      if (performance.now() - told > FACTS_MS) {
        told = performance.now();
        setFacts(image.facts);
      }
    };
    const turn = async (before) => {
      let refused = null;
      try {
        await ask("POST", "/live", {body: {camera, ...options}}).catch((problem) => {
          refused = problem;
        });
        // Somebody else's is watched in its place, once this page's own of before is over.
        if (refused && (refused.code !== "live-state" || before !== refused.code)) throw refused;
        setTheirs(Boolean(refused));
        await watch(size_px, shown, signal, show, setWhy);
      } catch (problem) {
        if (!signal.aborted) setWhy(problem.message);
      }
      if (!signal.aborted) setTimeout(() => signal.aborted || turn(refused?.code), AGAIN_MS);
    };
    // What is typed changes with every key, and one's own stream of before ends first.
    const timer = setTimeout(turn, begun.current ? CHANGED_MS : 0);
    begun.current = true;
    return () => {
      clearTimeout(timer);
      watching.abort();
    };
  }, [camera, JSON.stringify(options)]);
  return html`<div class="aimed depths">
    <figure><canvas ref=${shape} aria-label="Shape: drag turns it, the wheel zooms"></canvas><figcaption>Shape</figcaption></figure>
    <figure><canvas ref=${depth} role="img" aria-label="Depth in colours, near is yellow"></canvas><figcaption>Depth</figcaption></figure>
    <figure><canvas ref=${grey} role="img" aria-label=${`Light that camera ${camera} sees`}></canvas><figcaption>Camera ${camera}</figcaption></figure>
    <p class="told" role="status">${why ?? (facts && [theirs && THEIRS, aimWords(facts)].filter(Boolean).join(" "))}</p>
  </div>`;
}

/** What a depth image says of the aim. */
export function aimWords(facts) {
  const {shares} = facts;
  const words = [`${percent(shares.measured)} measured`];
  if (shares.outside > 0.002) words.push(`${percent(shares.outside)} outside the limits`);
  if (facts.distance_mm !== null) words.push(`${length(facts.distance_mm)} away, the axes meet at ${length(facts.meeting_mm)}`, `σ ${length(facts.sigma_mm)}`);
  if (facts.tilt_deg !== null) words.push(`tilted by ${number(facts.tilt_deg, {decimals: 1})}°`);
  if (facts.in_volume !== null) words.push(`${percent(facts.in_volume)} within the calibrated volume`);
  if (facts.blur_px !== null) words.push(`blur ${number(facts.blur_px, {decimals: 1})} px of the projector`);
  if (shares.saturated > 0.002) words.push(`${percent(shares.saturated)} saturated`);
  if (shares.moved > 0.002) words.push(`${percent(shares.moved)} moves${facts.moved_mm === null ? "" : `, by about ${length(facts.moved_mm)} within ${duration(facts.window_s)}: depth there is off`}`);
  return `${words.join("; ")}.`;
}

/** How many of the camera's pixels lie from point to point, where a part of so many pixels is shown on so many of the screen. */
export function stepOf(size_px, shown) {
  const points = Math.min(Math.max(shown / APART, FEWEST), MOST);
  return Math.min(Math.max(Math.round(Math.max(...size_px) / points), 1), 64);
}

/**
 * Show depth images until the service ends the stream, or `signal` is aborted. Throws why it ended. `size_px`: of the
 * camera; `shown()`: pixels of the screen along the longer side, as the window is now.
 */
async function watch(size_px, shown, signal, show, say) {
  let size = size_px;
  for (let again = true; again;) {
    const step = stepOf(size, shown());
    let rays = null;
    let waits = 0;
    let newest = null;
    let drawing = false;
    let problem = null;
    // The newest image counts: one that comes while another is drawn takes the place of those before it.
    const draw = async () => {
      drawing = true;
      try {
        while (newest) {
          const {head, body} = newest;
          newest = null;
          show(decoded(head, new Uint8Array(await inflated(body)), rays));
        }
      } catch (found) {
        problem = found;
      }
      drawing = false;
    };
    again = false;
    for await (const {head, body} of messages(`/live/depth?step=${step}`, signal)) {
      if (problem) throw problem;
      if (head.kind === "end") throw new Error(head.reason);
      waits = head.kind === "wait" ? waits + 1 : 0;
      if (waits > 3) say(head.reason);
      if (head.kind === "geometry") {
        const [left, top, right, bottom] = head.part_px;
        size = [right - left, bottom - top];
        rays = new Float32Array(await inflated(body));
      }
      // The limits leave a part of the picture, or the window has another size.
      again = stepOf(size, shown()) !== step;
      if (again) break;
      if (head.kind === "depth" && rays) {
        newest = {head, body};
        if (!drawing) draw();
      }
    }
  }
}

/** The messages of a stream, until it ends. The connection is closed when the caller breaks off. */
async function* messages(path, signal) {
  const response = await fetch(path, {signal});
  if (!response.ok) throw new Error((await response.json().catch(() => ({}))).detail ?? "Live depth cannot be watched.");
  const reader = response.body.getReader();
  try {
    let waiting = new Uint8Array(0);
    for (;;) {
      const {done, value} = await reader.read();
      if (done) return;
      waiting = joined(waiting, value);
      for (let message = taken(waiting); message; message = taken(waiting)) {
        waiting = waiting.subarray(message.end);
        yield message;
      }
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}

function joined(first, second) {
  if (!first.length) return second;
  const both = new Uint8Array(first.length + second.length);
  both.set(first);
  both.set(second, first.length);
  return both;
}

/** The first message of some bytes: its head, its body, and where it ends; null where it has not come whole. */
function taken(bytes) {
  if (bytes.length < HEAD_BYTES) return null;
  const sizes = new DataView(bytes.buffer, bytes.byteOffset, HEAD_BYTES);
  const [text, body] = [sizes.getUint32(0, true), sizes.getUint32(4, true)];
  const end = HEAD_BYTES + text + body;
  if (bytes.length < end) return null;
  return {head: JSON.parse(new TextDecoder().decode(bytes.subarray(HEAD_BYTES, HEAD_BYTES + text))), body: bytes.subarray(HEAD_BYTES + text, end), end};
}

const inflated = (bytes) => new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();

/** A depth image of a message: see `slrig/live/stream.py`. depth: mm, NaN where there is none. */
export function decoded(head, planes, rays) {
  const {width, height, near_mm: near, unit_mm: unit} = head;
  const size = width * height;
  const depth = new Float32Array(size);
  for (let row = 0; row < height; row += 1) {
    let q = 0;
    for (let at = row * width; at < (row + 1) * width; at += 1) {
      q = (q + planes[at] + 256 * planes[size + at]) & 0xffff;
      depth[at] = q ? near + (q - 1) * unit : NaN;
    }
  }
  return {width, height, depth, rays, state: planes.subarray(3 * size, 4 * size), grey: planes.subarray(4 * size, 5 * size), facts: head};
}

function paint(canvas, {width, height}, colour) {
  if (!canvas) return;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
  const context = canvas.getContext("2d");
  const picture = context.createImageData(width, height);
  for (let at = 0, byte = 0; at < width * height; at += 1) {
    const shade = colour(at);
    picture.data[byte++] = shade[0];
    picture.data[byte++] = shade[1];
    picture.data[byte++] = shade[2];
    picture.data[byte++] = 255;
  }
  context.putImageData(picture, 0, 0);
}

/** The colour of each point by its depth, yellow near and blue far, over the middle 96 % of what is measured. */
function depthColour({depth, state}) {
  const few = [];
  for (let at = 0; at < depth.length; at += 13) if (state[at] === MEASURED) few.push(depth[at]);
  few.sort((a, b) => a - b);
  const [low, high] = [few[Math.floor(0.02 * few.length)] ?? 0, few[Math.floor(0.98 * few.length)] ?? 1];
  return (at) => {
    if (state[at] !== MEASURED) return COLOURS[state[at]] ?? [0, 0, 0];
    const share = Math.min(Math.max((depth[at] - low) / (high - low || 1), 0), 1);
    return [250 - 200 * share, 220 - 110 * share - 40 * share * share, 60 + 100 * share];
  };
}

const VERTEX = "attribute float light; varying vec3 seen; varying float own; void main() { vec4 placed = modelViewMatrix * vec4(position, 1.0); seen = placed.xyz; own = light; gl_Position = projectionMatrix * placed; }";
const FRAGMENT = "varying vec3 seen; varying float own; void main() { vec3 n = normalize(cross(dFdx(seen), dFdy(seen))); float light = 0.25 + 0.75 * abs(dot(n, normalize(vec3(-0.35, 0.5, 0.8)))); gl_FragColor = vec4(vec3(light * (0.55 + 0.45 * own)), 1.0); }";

/** The shape in 3-D, as triangles between neighbouring points; null where the browser has no WebGL 2. */
function shapeView(canvas) {
  let renderer;
  try {
    renderer = new WebGLRenderer({canvas, antialias: false, alpha: true});
  } catch {
    return null;
  }
  const scene = new Scene();
  const camera = new PerspectiveCamera(30, 1, 1, 1e5);
  const controls = new OrbitControls(camera, canvas);
  const geometry = new BufferGeometry();
  const mesh = Object.assign(new Mesh(geometry, new ShaderMaterial({vertexShader: VERTEX, fragmentShader: FRAGMENT, side: DoubleSide})), {frustumCulled: false});
  scene.add(mesh);
  let placed = false;
  let drawn = 0;
  const draw = () => {
    const {clientWidth: width, clientHeight: height} = canvas;
    if (!width) return;
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    renderer.render(scene, camera);
  };
  controls.addEventListener("change", draw);
  return {
    show(image) {
      if (performance.now() - drawn < SHAPE_MS) return;
      drawn = performance.now();
      const {positions, lights, corners} = triangles(image);
      geometry.setAttribute("position", new BufferAttribute(positions, 3));
      geometry.setAttribute("light", new BufferAttribute(lights, 1));
      geometry.setIndex(new BufferAttribute(corners, 1));
      if (!placed && corners.length) {
        placed = true;
        const {center, radius} = sphereOf(positions, corners);
        controls.target.set(...center);
        camera.position.set(center[0] - radius, center[1] + 0.8 * radius, center[2] + 4 * radius);
        controls.update();
      }
      draw();
    },
    dispose() {
      controls.dispose();
      geometry.dispose();
      mesh.material.dispose();
      renderer.dispose();
      renderer.forceContextLoss();
    },
  };
}

/** The middle of the points that triangles have, and the distance within which nine of ten of them lie. */
function sphereOf(positions, corners) {
  const few = [];
  for (let at = 0; at < corners.length; at += 3 * 37) few.push([0, 1, 2].map((axis) => positions[3 * corners[at] + axis]));
  const center = [0, 1, 2].map((axis) => few.map((point) => point[axis]).sort((a, b) => a - b)[Math.floor(few.length / 2)]);
  const away = few.map((point) => Math.hypot(...point.map((each, axis) => each - center[axis]))).sort((a, b) => a - b);
  return {center, radius: Math.max(away[Math.floor(0.9 * away.length)], 1)};
}

/** Points of an image, y up and z towards the camera, and the triangles between those that lie on one surface. */
export function triangles({width, height, depth, rays, state, grey}) {
  const positions = new Float32Array(3 * width * height);
  const lights = new Float32Array(width * height);
  const corners = new Uint32Array(6 * (width - 1) * (height - 1));
  for (let at = 0; at < depth.length; at += 1) {
    const z = state[at] === MEASURED ? depth[at] : 0;
    positions[3 * at] = rays[2 * at] * z;
    positions[3 * at + 1] = -rays[2 * at + 1] * z;
    positions[3 * at + 2] = -z;
    lights[at] = grey[at] / 255;
  }
  const beside = (a, b) => Math.abs(depth[a] - depth[b]) < STEP * depth[a];
  const known = (a) => state[a] === MEASURED;
  let count = 0;
  for (let row = 0; row + 1 < height; row += 1) {
    for (let column = 0; column + 1 < width; column += 1) {
      const [a, c] = [row * width + column, (row + 1) * width + column];
      if (known(a) && known(a + 1) && known(c) && known(c + 1) && beside(a, a + 1) && beside(a, c) && beside(a, c + 1)) {
        corners.set([a, c, a + 1, a + 1, c, c + 1], count);
        count += 6;
      }
    }
  }
  return {positions, lights, corners: corners.subarray(0, count)};
}
