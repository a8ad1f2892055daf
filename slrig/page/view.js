// The mesh in 3-D: a scene that draws only when something changed, the coarse mesh while a slow machine turns the full one.
import {
  Box3, Box3Helper, BufferAttribute, BufferGeometry, Color, DoubleSide, LineSegments, Matrix4, Mesh, PerspectiveCamera, Points, Scene, ShaderMaterial, Vector2,
  Vector3, WebGLRenderer,
} from "three";
import {firstHit} from "./glb.js";
import {OrbitControls} from "./vendor/OrbitControls.js";

export const MODES = ["shaded", "albedo", "sigma", "stripe", "depth", "deviation", "cause", "views"];
export const FORMS = ["surface", "points", "wires"];
const FIELD_DEG = 30;
/** A frame that takes longer is not turned smoothly. */
const SMOOTH_MS = 50;
const LIKELY_SMOOTH_TRIANGLES = 200_000;
const STILL_AFTER_MS = 250;
const CLICK_PX = 5;
const MOST_OUTLINED = 30_000;
/** What stands over the canvas and its mesh's edges: CSS px at the top and the bottom, and on either side. */
const [TOP_PX, BOTTOM_PX, SIDE_PX] = [60, 56, 16];
const LIMITS = "#56b4e9";
/** A box that a scan was limited to is fitted to the window, too, unless it is so many times as large as the mesh. */
const WIDE_LIMITS = 3;
const NAMES = {POSITION: "position", NORMAL: "normal", COLOR_0: "albedo", _SIGMA: "sigma", _STRIPE: "stripe"};

/**
 * The colours of values lie on a parabola through these points of OKLab (Ottosson 2020, "A perceptual color space for image processing"). Lightness
 * rises evenly, from blue over green to yellow, which the colour-blind tell apart, too; equal steps look equal within 10 %.
 */
const ON_SCALE = [[0.28, 0.04, -0.13], [0.6, -0.075, -0.025], [0.92, -0.05, 0.16]];
const weights = (share) => [(1 - 2 * share) * (1 - share), 4 * share * (1 - share), share * (2 * share - 1)];
const scaled = (share) => [0, 1, 2].map((axis) => weights(share).reduce((sum, weight, at) => sum + weight * ON_SCALE[at][axis], 0).toFixed(4));
export const SCALE_CSS = `linear-gradient(in oklab to right, ${Array.from({length: 17}, (_, at) => `oklab(${scaled(at / 16).join(" ")})`).join(", ")})`;
/** Of what has a sign: blue below, light grey at nothing, orange above. */
const SIGNED = [[0.5, -0.04, -0.17], [0.93, 0, 0], [0.62, 0.1, 0.12]];
export const SIGNED_CSS = `linear-gradient(in oklab to right, ${SIGNED.map((point) => `oklab(${point.join(" ")})`).join(", ")})`;
/** Of kinds, at most so many. */
const MOST_KINDS = 32;
/** Of what is seen from behind, as light. */
const BACK = [0.6, 0.08, 0.05];
export const BACK_CSS = "#cc503f";

const VERTEX = `
attribute vec4 albedo; attribute float sigma; attribute float stripe; attribute float told;
uniform int mode; uniform vec2 depth; uniform float dot_px;
varying vec3 facing; varying vec3 seen; varying vec3 own; varying float value;
void main() {
  vec4 placed = modelViewMatrix * vec4(position, 1.0);
  seen = placed.xyz;
  facing = normalMatrix * normal;
  own = albedo.rgb;
  value = mode == 2 ? sigma : mode == 3 ? stripe : mode == 4 ? depth.x + depth.y * position.z : told;
  gl_PointSize = dot_px;
  gl_Position = projectionMatrix * placed;
}`;
const vec3 = (point) => `vec3(${point.map((each) => each.toFixed(6)).join(", ")})`;
const [LOW, MIDDLE, HIGH] = ON_SCALE.map(vec3);
const [BELOW, NOTHING, ABOVE] = SIGNED.map(vec3);
const FRAGMENT = `
uniform int mode; uniform bool bare; uniform bool solid; uniform vec2 range; uniform vec3 plain; uniform vec3 kinds[${MOST_KINDS}];
varying vec3 facing; varying vec3 seen; varying vec3 own; varying float value;
vec3 rgb(vec3 lab) {
  vec3 root = lab.x + mat3(0.3963377774, -0.1055613458, -0.0894841775, 0.2158037573, -0.0638541728, -1.2914855480, 0.0, 0.0, 0.0) * lab.yzx;
  return mat3(4.0767416621, -1.2684380046, -0.0041960863, -3.3077115913, 2.6097574011, -0.7034186147, 0.2309699292, -0.3413193965, 1.7076147010)
    * (root * root * root);
}
vec3 scaled(float share) { return rgb((1.0 - 2.0 * share) * (1.0 - share) * ${LOW} + 4.0 * share * (1.0 - share) * ${MIDDLE} + share * (2.0 * share - 1.0) * ${HIGH}); }
vec3 signed(float share) { return rgb(share < 0.5 ? mix(${BELOW}, ${NOTHING}, 2.0 * share) : mix(${NOTHING}, ${ABOVE}, 2.0 * share - 1.0)); }
void main() {
  bool front = !solid || gl_FrontFacing;
  vec3 n = !bare ? normalize(facing) * (front ? 1.0 : -1.0) : solid ? normalize(cross(dFdx(seen), dFdy(seen))) : vec3(0.0, 0.0, 1.0);
  float light = max(dot(n, normalize(vec3(-0.35, 0.5, 0.8))), 0.0);
  vec3 colour;
  float share = clamp((value - range.x) / (range.y - range.x), 0.0, 1.0);
  if (mode == 0) colour = (0.18 + 0.82 * light) * (front ? plain : vec3(${BACK.join(", ")}));
  else if (mode == 1) colour = own;
  else if (mode >= 6) colour = (0.55 + 0.45 * light) * kinds[clamp(int(value + 0.5), 0, ${MOST_KINDS - 1})];
  else if (value > 65534.0) colour = vec3(0.2);
  else colour = mode == 5 ? signed(share) : scaled(share);
  gl_FragColor = vec4(colour, 1.0);
  #include <colorspace_fragment>
}`;

/** `drawn()` is called after each picture. Throws where the browser has no WebGL 2. */
export class View {
  constructor(canvas, drawn) {
    this.canvas = canvas;
    this.drawn = drawn;
    this.renderer = new WebGLRenderer({canvas, antialias: false, alpha: true});
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(FIELD_DEG, 1, 1, 1000);
    this.controls = new OrbitControls(this.camera, canvas);
    const kinds = Array.from({length: MOST_KINDS}, () => new Color());
    this.shared = {mode: {value: 0}, range: {value: new Vector2(0, 1)}, kinds: {value: kinds}, dot_px: {value: 2}};
    this.form = "surface";
    this.slots = [];
    this.shown = [true, true];
    this.moving = false;
    this.fullMs = null;
    this.controls.addEventListener("change", () => this.move());
    this.sizes = new ResizeObserver(() => this.fitCanvas());
    this.sizes.observe(canvas);
    this.fitCanvas();
  }

  dispose() {
    cancelAnimationFrame(this.frame);
    clearTimeout(this.timer);
    this.sizes.disconnect();
    this.controls.dispose();
    [0, 1].forEach((slot) => this.hold(slot, {}));
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.gone = true;
  }

  /** Have in slot 0 (this scan) or 1 (the one beside it) these meshes: `coarse`, `full`, both or none. */
  hold(slot, meshes, plain) {
    const held = this.slots[slot] ?? {};
    for (const [level, {mesh}] of Object.entries(held)) if (meshes[level] !== mesh) this.drop(slot, level);
    for (const [level, mesh] of Object.entries(meshes)) if (this.slots[slot]?.[level]?.mesh !== mesh) this.add(slot, level, mesh, plain);
    this.redraw();
  }

  add(slot, level, mesh, plain) {
    const geometry = new BufferGeometry();
    for (const [name, {array, width, normalized}] of Object.entries(mesh.attributes))
      geometry.setAttribute(NAMES[name], new BufferAttribute(array, width, normalized));
    if (mesh.corners) geometry.setIndex(new BufferAttribute(mesh.corners, 1));
    const [x, y, z] = mesh.originMm;
    const own = {plain: {value: new Color(plain)}, bare: {value: !mesh.attributes.NORMAL}, depth: {value: new Vector2(z, mesh.stepMm)}};
    // Half a turn about x: the scan's y is down and its z away, the view's y is up and its z towards the viewer.
    const matrix = new Matrix4().makeScale(mesh.stepMm, -mesh.stepMm, -mesh.stepMm).setPosition(x, -y, -z);
    const first = this.slots.length === 0;
    this.slots[slot] = {...this.slots[slot], [level]: {mesh, geometry, matrix, own, shapes: {}}};
    if (first) this.front();
  }

  /** What draws a mesh in one of FORMS, made when it is first drawn. */
  shape(held, form) {
    const {geometry, matrix, own, mesh} = held;
    const solid = form === "surface" && mesh.corners !== null;
    const build = () => {
      const material = new ShaderMaterial({vertexShader: VERTEX, fragmentShader: FRAGMENT, side: DoubleSide, uniforms: {...this.shared, ...own, solid: {value: solid}}});
      if (solid) return new Mesh(geometry, material);
      const part = new BufferGeometry();
      for (const [name, attribute] of Object.entries(geometry.attributes)) part.setAttribute(name, attribute);
      if (form === "wires" && mesh.corners) part.setIndex(new BufferAttribute(edgesOf(mesh.corners), 1));
      return form === "wires" && mesh.corners ? new LineSegments(part, material) : new Points(part, material);
    };
    if (!held.shapes[form]) {
      held.shapes[form] = Object.assign(build(), {matrix, matrixAutoUpdate: false, frustumCulled: false});
      this.scene.add(held.shapes[form]);
    }
    return held.shapes[form];
  }

  /** A number for each vertex of a mesh that is held, for the modes after depth: Float32Array. */
  tell(mesh, values) {
    for (const held of this.slots.flatMap((each) => Object.values(each)).filter((each) => each.mesh === mesh)) {
      const {geometry, shapes} = held;
      const told = geometry.getAttribute("told") ?? new BufferAttribute(new Float32Array(mesh.vertices), 1);
      told.array.set(values);
      told.needsUpdate = true;
      for (const each of [geometry, ...Object.values(shapes).map((shape) => shape.geometry)]) each.setAttribute("told", told);
    }
    this.redraw();
  }

  /** Draw the box that a scan was limited to, its least and greatest corner in mm, as lines; null for none. */
  limit(box_mm) {
    if (this.limits) {
      this.scene.remove(this.limits);
      this.limits.dispose();
    }
    this.limits = null;
    if (box_mm) {
      const [[x, y, z], [right, down, away]] = box_mm;
      this.limits = new Box3Helper(new Box3(new Vector3(x, -down, -away), new Vector3(right, -y, -z)), LIMITS);
      this.scene.add(this.limits);
    }
    this.redraw();
  }

  drop(slot, level) {
    const {geometry, shapes} = this.slots[slot][level];
    for (const object of Object.values(shapes)) this.remove(object);
    geometry.dispose();
    delete this.slots[slot][level];
    if (Object.keys(this.slots[slot]).length === 0) delete this.slots[slot];
  }

  remove(object) {
    this.scene.remove(object);
    object.geometry.dispose();
    object.material.dispose();
  }

  /**
   * Colour by one of MODES, in one of FORMS; `range` of its values, as stored or in mm; `kinds`: the CSS colour of each whole number, for modes of kinds; `shown`: is
   * each slot's mesh shown.
   */
  set(mode, form, range, kinds, shown) {
    this.shared.mode.value = MODES.indexOf(mode);
    this.shared.range.value.set(...range);
    kinds.slice(0, MOST_KINDS).forEach((colour, at) => this.shared.kinds.value[at].set(colour));
    this.form = form;
    this.shown = shown;
    // Points and wires take as much memory again as the surface: they go when they are no more shown.
    for (const {shapes} of this.slots.flatMap((each) => Object.values(each))) {
      for (const other of Object.keys(shapes).filter((each) => ![form, "surface"].includes(each))) {
        this.remove(shapes[other]);
        delete shapes[other];
      }
    }
    this.redraw();
  }

  move() {
    this.moving = true;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      this.moving = false;
      this.redraw();
    }, STILL_AFTER_MS);
    this.redraw();
  }

  redraw() {
    cancelAnimationFrame(this.frame);
    if (!this.gone) this.frame = requestAnimationFrame(() => this.draw());
  }

  draw() {
    const heavy = this.slots.reduce((sum, each) => sum + (each.full?.mesh.triangles ?? 0), 0);
    const slow = this.fullMs === null ? heavy > LIKELY_SMOOTH_TRIANGLES : this.fullMs > SMOOTH_MS;
    const level = this.moving && slow ? "coarse" : "full";
    this.slots.forEach((each, slot) => {
      const chosen = each[level] ?? each.full ?? each.coarse;
      const drawn = chosen && this.shown[slot] ? this.shape(chosen, this.form) : null;
      for (const object of Object.values(each).flatMap(({shapes}) => Object.values(shapes))) object.visible = object === drawn;
    });
    const {center, radius} = this.box;
    const away = this.camera.position.distanceTo(center);
    const limits = this.limits?.box;
    const reach = limits ? Math.max(radius, center.distanceTo(limits.getCenter(new Vector3())) + limits.min.distanceTo(limits.max) / 2) : radius;
    this.camera.near = Math.max(away - reach * 1.1, away / 1000, 1e-3);
    this.camera.far = away + reach * 1.1;
    this.camera.updateProjectionMatrix();
    const began = performance.now();
    this.renderer.render(this.scene, this.camera);
    if (!this.moving) this.finish(began, level);
    this.drawn();
  }

  /** Wait for a mesh's first pictures, to know how long one takes: the very first also brings it to the graphics memory. */
  finish(began, level) {
    const held = this.slots.find((each) => each)?.[level];
    if (held && (held.pictures = (held.pictures ?? 0) + 1) <= 2) {
      const gl = this.renderer.getContext();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      const ms = performance.now() - began;
      if (held.pictures === 2) this.fullMs = ms;
      this.canvas.dataset.ms = Math.round(ms);
    }
    Object.assign(this.canvas.dataset, {level: held ? level : "coarse", triangles: this.renderer.info.render.triangles});
  }

  fitCanvas() {
    const {clientWidth, clientHeight} = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.shared.dot_px.value = 2 * Math.min(devicePixelRatio, 2);
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.redraw();
  }

  /** The box about all that is there, in the view's axes: `center`, `corners`, and `radius` to each of these. */
  get box() {
    const box = new Box3();
    for (const {mesh, matrix} of this.slots.flatMap((each) => Object.values(each)))
      box.union(new Box3(new Vector3(...mesh.min), new Vector3(...mesh.max)).applyMatrix4(matrix));
    if (box.isEmpty()) box.set(new Vector3(-1, -1, -1), new Vector3(1, 1, 1));
    return {center: box.getCenter(new Vector3()), corners: cornersOf(box), radius: Math.max(box.min.distanceTo(box.max) / 2, 1e-3)};
  }

  /** All in view, from the side that it is looked at from, between what stands over the canvas. */
  fit() {
    const {clientWidth, clientHeight} = this.canvas;
    const [right, up, toViewer] = [0, 1, 2].map((axis) => new Vector3().setFromMatrixColumn(this.camera.matrix, axis));
    const high = Math.tan((FIELD_DEG * Math.PI) / 360);
    const side = high * this.camera.aspect * (1 - (2 * SIDE_PX) / clientWidth);
    const [top, bottom] = [TOP_PX, BOTTOM_PX].map((px) => high * Math.max(1 - (2 * px) / clientHeight, 0.3));
    // Of a camera at (x, y, z) along right, up and towards the viewer, a point p is inside on the right where p·right + side p·toViewer <= x + side z, and so on.
    const most = {right: -Infinity, left: -Infinity, up: -Infinity, down: -Infinity};
    for (const point of this.outline()) {
      const [x, y, z] = [right, up, toViewer].map((axis) => point.dot(axis));
      most.right = Math.max(most.right, x + side * z);
      most.left = Math.max(most.left, -x + side * z);
      most.up = Math.max(most.up, y + top * z);
      most.down = Math.max(most.down, -y + bottom * z);
    }
    const z = Math.max((most.right + most.left) / (2 * side), (most.up + most.down) / (top + bottom));
    const x = (most.right - most.left) / 2;
    const y = (most.up - top * z + bottom * z - most.down) / 2;
    const eye = new Vector3().addScaledVector(right, x).addScaledVector(up, y).addScaledVector(toViewer, z);
    this.look(eye, eye.clone().addScaledVector(toViewer, this.box.center.dot(toViewer) - z));
  }

  /** Points of all that is there, in the view's axes: some thousand vertices, or the box's corners where there is no mesh. */
  * outline() {
    if (this.slots.length === 0) yield* this.box.corners;
    const limits = this.limits?.box;
    if (limits && limits.min.distanceTo(limits.max) < 2 * WIDE_LIMITS * this.box.radius) yield* cornersOf(limits);
    for (const {coarse, full} of this.slots.filter((each) => each)) {
      const {mesh, matrix} = coarse ?? full;
      const {array, width} = mesh.attributes.POSITION ?? {array: [], width: 1};
      const every = width * Math.ceil(mesh.vertices / MOST_OUTLINED || 1);
      for (let at = 0; at < array.length; at += every) yield new Vector3().fromArray(array, at).applyMatrix4(matrix);
    }
  }

  /** As at the beginning: from the side of the cameras, all in view. */
  front() {
    this.look(new Vector3(0, 0, 1), new Vector3());
    this.fit();
  }

  /** From where a camera stood: `centreMm` and `rotation` of the report, X_cam = R (X - centre), the scan's axes. */
  from({centre_mm: [x, y, z], rotation}) {
    const eye = new Vector3(x, -y, -z);
    const [ax, ay, az] = rotation[2];
    const along = new Vector3(ax, -ay, -az);
    this.look(eye, eye.clone().addScaledVector(along, this.box.center.clone().sub(eye).dot(along)));
  }

  look(eye, target) {
    this.camera.position.copy(eye);
    this.controls.target.copy(target);
    this.controls.update();
    clearTimeout(this.timer);
    this.moving = false;
    this.redraw();
  }

  turn(leftDeg, upDeg) {
    this.controls.rotateLeft((leftDeg * Math.PI) / 180);
    this.controls.rotateUp((upDeg * Math.PI) / 180);
  }

  closer(factor) {
    this.controls.dollyIn(1 / factor);
  }

  /** The point of the nearest shown mesh at (x, y) of the canvas, CSS px: see `firstHit`, with `slot`, `mesh`, and `along`, from the eye, mm; null where there is none. */
  pick(x, y) {
    const {clientWidth, clientHeight} = this.canvas;
    const far = new Vector3((2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight, 0.5).unproject(this.camera);
    return this.meet(this.camera.position, far.sub(this.camera.position));
  }

  /** The same for a ray from a point of the scan, mm, in its axes. */
  seenFrom(fromMm, along) {
    const [from, to] = [fromMm, along].map(([x, y, z]) => new Vector3(x, -y, -z));
    return this.meet(from, to);
  }

  meet(eye, ray) {
    let nearest = null;
    this.slots.forEach(({full, coarse}, slot) => {
      const {mesh, matrix} = full ?? coarse;
      if (!this.shown[slot]) return;
      const stored = matrix.clone().invert();
      const from = eye.clone().applyMatrix4(stored);
      const hit = firstHit(mesh, from.toArray(), eye.clone().add(ray).applyMatrix4(stored).sub(from).toArray());
      if (hit && hit.distance < (nearest?.distance ?? Infinity)) nearest = {...hit, slot, mesh, along: [ray.x, -ray.y, -ray.z]};
    });
    return nearest;
  }

  /** The least and the greatest corner of a box in whole mm about what of this scan's mesh is on the canvas; null for nothing. */
  seen() {
    const {mesh, matrix} = this.slots[0]?.full ?? this.slots[0]?.coarse ?? {};
    const {array, width} = mesh?.attributes.POSITION ?? {array: []};
    const box = new Box3();
    const [point, at] = [new Vector3(), new Vector3()];
    for (let start = 0; start < array.length; start += width) {
      at.copy(point.fromArray(array, start).applyMatrix4(matrix)).project(this.camera);
      if (Math.abs(at.x) < 1 && Math.abs(at.y) < 1) box.expandByPoint(point);
    }
    const {min, max} = box;
    return box.isEmpty() ? null : [[min.x, -max.y, -max.z].map(Math.floor), [max.x, -min.y, -min.z].map((mm) => Math.floor(mm) + 1)];
  }

  /** Where a point of the scan, mm, stands on the canvas, CSS px. */
  place([x, y, z]) {
    const at = new Vector3(x, -y, -z).project(this.camera);
    return [((at.x + 1) / 2) * this.canvas.clientWidth, ((1 - at.y) / 2) * this.canvas.clientHeight];
  }

  /** CSS pixels that a millimetre at a point of the scan, mm, spans. */
  pxPerMm([x, y, z]) {
    const away = -new Vector3(x, -y, -z).applyMatrix4(this.camera.matrixWorldInverse).z;
    return this.canvas.clientHeight / (2 * away * Math.tan((FIELD_DEG * Math.PI) / 360));
  }

  /** Millimetres that a CSS pixel spans at what the view turns about. */
  get mmPerPx() {
    const away = this.camera.position.distanceTo(this.controls.target);
    return (2 * away * Math.tan((FIELD_DEG * Math.PI) / 360)) / this.canvas.clientHeight;
  }

  /** Call `clicked(x, y)` for a press that is let go where it began: turning is no click. Returns what ends it. */
  clicks(clicked) {
    let began = null;
    const ending = new AbortController();
    const on = (kind, told) => this.canvas.addEventListener(kind, told, {signal: ending.signal});
    on("pointerdown", (event) => {
      began = event.isPrimary ? event : null;
    });
    on("pointerup", (event) => {
      if (began && Math.hypot(event.clientX - began.clientX, event.clientY - began.clientY) < CLICK_PX) clicked(event.offsetX, event.offsetY);
      began = null;
    });
    return () => ending.abort();
  }
}

const cornersOf = ({min, max}) => [min.x, max.x].flatMap((x) => [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => new Vector3(x, y, z))));

/** The two ends of each side of each triangle. */
function edgesOf(corners) {
  const edges = new Uint32Array(2 * corners.length);
  for (let at = 0; at < corners.length; at += 1) {
    edges[2 * at] = corners[at];
    edges[2 * at + 1] = corners[at % 3 === 2 ? at - 2 : at + 1];
  }
  return edges;
}
