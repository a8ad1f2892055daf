// The mesh in 3-D: a scene that draws only when something changed, the coarse mesh while a slow machine turns the full one.
import {
  Box3, Box3Helper, BufferAttribute, BufferGeometry, Color, DoubleSide, Matrix4, Mesh, PerspectiveCamera, Points, Scene, ShaderMaterial, Vector2, Vector3, WebGLRenderer,
} from "three";
import {firstHit} from "./glb.js";
import {OrbitControls} from "./vendor/OrbitControls.js";

export const MODES = ["shaded", "albedo", "sigma", "stripe"];
const FIELD_DEG = 30;
/** A frame that takes longer is not turned smoothly. */
const SMOOTH_MS = 50;
const LIKELY_SMOOTH_TRIANGLES = 200_000;
const STILL_AFTER_MS = 250;
const CLICK_PX = 5;
/** So much of the canvas does the mesh fill at most. */
const FILLED = 0.92;
const LIMITS = "#0072b2";
const NAMES = {POSITION: "position", NORMAL: "normal", COLOR_0: "albedo", _SIGMA: "sigma", _STRIPE: "stripe"};

/**
 * The colours of values lie on a parabola through these points of OKLab (Ottosson 2020, "A perceptual color space for image processing"). Lightness
 * rises evenly, from blue over green to yellow, which the colour-blind tell apart, too; equal steps look equal within 10 %.
 */
const ON_SCALE = [[0.28, 0.04, -0.13], [0.6, -0.075, -0.025], [0.92, -0.05, 0.16]];
const weights = (share) => [(1 - 2 * share) * (1 - share), 4 * share * (1 - share), share * (2 * share - 1)];
const scaled = (share) => [0, 1, 2].map((axis) => weights(share).reduce((sum, weight, at) => sum + weight * ON_SCALE[at][axis], 0).toFixed(4));
export const SCALE_CSS = `linear-gradient(in oklab to right, ${Array.from({length: 17}, (_, at) => `oklab(${scaled(at / 16).join(" ")})`).join(", ")})`;

const VERTEX = `
attribute vec4 albedo; attribute float sigma; attribute float stripe;
uniform int mode;
varying vec3 facing; varying vec3 seen; varying vec3 own; varying float value;
void main() {
  vec4 placed = modelViewMatrix * vec4(position, 1.0);
  seen = placed.xyz;
  facing = normalMatrix * normal;
  own = albedo.rgb;
  value = mode == 2 ? sigma : stripe;
  gl_PointSize = 2.0;
  gl_Position = projectionMatrix * placed;
}`;
const [LOW, MIDDLE, HIGH] = ON_SCALE.map((point) => `vec3(${point.join(", ")})`);
const FRAGMENT = `
uniform int mode; uniform bool bare; uniform vec2 range; uniform vec3 plain;
varying vec3 facing; varying vec3 seen; varying vec3 own; varying float value;
vec3 scaled(float share) {
  vec3 lab = (1.0 - 2.0 * share) * (1.0 - share) * ${LOW} + 4.0 * share * (1.0 - share) * ${MIDDLE} + share * (2.0 * share - 1.0) * ${HIGH};
  vec3 root = lab.x + mat3(0.3963377774, -0.1055613458, -0.0894841775, 0.2158037573, -0.0638541728, -1.2914855480, 0.0, 0.0, 0.0) * lab.yzx;
  return mat3(4.0767416621, -1.2684380046, -0.0041960863, -3.3077115913, 2.6097574011, -0.7034186147, 0.2309699292, -0.3413193965, 1.7076147010)
    * (root * root * root);
}
void main() {
  vec3 colour;
  if (mode == 0) {
    vec3 n = bare ? normalize(cross(dFdx(seen), dFdy(seen))) : normalize(facing) * (gl_FrontFacing ? 1.0 : -1.0);
    float lit = 0.18 + 0.82 * max(dot(n, normalize(vec3(-0.35, 0.5, 0.8))), 0.0);
    colour = lit * (gl_FrontFacing ? plain : vec3(0.6, 0.08, 0.05));
  } else if (mode == 1) colour = own;
  else colour = value > 65534.0 ? vec3(0.2) : scaled(clamp((value - range.x) / (range.y - range.x), 0.0, 1.0));
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
    this.shared = {mode: {value: 0}, range: {value: new Vector2(0, 1)}};
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
    for (const [level, {mesh, object}] of Object.entries(held)) if (meshes[level] !== mesh) this.drop(slot, level, object);
    for (const [level, mesh] of Object.entries(meshes)) if (held[level]?.mesh !== mesh) this.add(slot, level, mesh, plain);
    this.redraw();
  }

  add(slot, level, mesh, plain) {
    const geometry = new BufferGeometry();
    for (const [name, {array, width, normalized}] of Object.entries(mesh.attributes))
      geometry.setAttribute(NAMES[name], new BufferAttribute(array, width, normalized));
    if (mesh.corners) geometry.setIndex(new BufferAttribute(mesh.corners, 1));
    const material = new ShaderMaterial({
      vertexShader: VERTEX, fragmentShader: FRAGMENT, side: DoubleSide,
      uniforms: {...this.shared, plain: {value: new Color(plain)}, bare: {value: !mesh.attributes.NORMAL}},
    });
    const object = mesh.corners ? new Mesh(geometry, material) : new Points(geometry, material);
    const [x, y, z] = mesh.originMm;
    // Half a turn about x: the scan's y is down and its z away, the view's y is up and its z towards the viewer.
    object.matrix = new Matrix4().makeScale(mesh.stepMm, -mesh.stepMm, -mesh.stepMm).setPosition(x, -y, -z);
    object.matrixAutoUpdate = false;
    object.frustumCulled = false;
    this.scene.add(object);
    const first = this.slots.length === 0;
    this.slots[slot] = {...this.slots[slot], [level]: {mesh, object}};
    if (first) this.front();
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

  drop(slot, level, object) {
    this.scene.remove(object);
    object.geometry.dispose();
    object.material.dispose();
    delete this.slots[slot][level];
    if (Object.keys(this.slots[slot]).length === 0) delete this.slots[slot];
  }

  /** Colour by one of MODES; `range` in stored units of sigma or stripe; `shown`: is each slot's mesh shown. */
  set(mode, range, shown) {
    this.shared.mode.value = MODES.indexOf(mode);
    this.shared.range.value.set(...range);
    this.shown = shown;
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
      for (const held of Object.values(each)) held.object.visible = held === chosen && this.shown[slot];
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

  /** Wait for the picture, to know how long one takes. The first one of a mesh also brings it to the graphics memory. */
  finish(began, level) {
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    const held = this.slots.find((each) => each)?.[level];
    if (held?.drawn) this.fullMs = performance.now() - began;
    if (held) held.drawn = true;
    const {triangles} = this.renderer.info.render;
    Object.assign(this.canvas.dataset, {level: held ? level : "coarse", triangles, ms: Math.round(performance.now() - began)});
  }

  fitCanvas() {
    const {clientWidth, clientHeight} = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.redraw();
  }

  /** The box about all that is there, in the view's axes: `center`, `corners`, and `radius` to each of these. */
  get box() {
    const box = new Box3();
    for (const {mesh, object} of this.slots.flatMap((each) => Object.values(each)))
      box.union(new Box3(new Vector3(...mesh.min), new Vector3(...mesh.max)).applyMatrix4(object.matrix));
    if (box.isEmpty()) box.set(new Vector3(-1, -1, -1), new Vector3(1, 1, 1));
    const {min, max} = box;
    const corners = [min.x, max.x].flatMap((x) => [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => new Vector3(x, y, z))));
    return {center: box.getCenter(new Vector3()), corners, radius: Math.max(min.distanceTo(max) / 2, 1e-3)};
  }

  /** All in view, from the side that it is looked at from. */
  fit() {
    const {center} = this.box;
    const toViewer = new Vector3().setFromMatrixColumn(this.camera.matrix, 2);
    const [right, up] = [0, 1].map((axis) => new Vector3().setFromMatrixColumn(this.camera.matrix, axis));
    const high = Math.tan((FIELD_DEG * Math.PI) / 360) * FILLED;
    const needed = this.box.corners.map((corner) => {
      const at = corner.clone().sub(center);
      return at.dot(toViewer) + Math.max(Math.abs(at.dot(right)) / this.camera.aspect, Math.abs(at.dot(up))) / high;
    });
    this.look(center.clone().addScaledVector(toViewer, Math.max(...needed)), center);
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

  /** The point of the nearest shown mesh at (x, y) of the canvas, CSS px: see `firstHit`, with `slot`; null where there is none. */
  pick(x, y) {
    const {clientWidth, clientHeight} = this.canvas;
    const far = new Vector3((2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight, 0.5).unproject(this.camera);
    let nearest = null;
    this.slots.forEach(({full, coarse}, slot) => {
      const {mesh, object} = full ?? coarse;
      if (!this.shown[slot]) return;
      const stored = object.matrix.clone().invert();
      const from = this.camera.position.clone().applyMatrix4(stored);
      const hit = firstHit(mesh, from.toArray(), far.clone().applyMatrix4(stored).sub(from).toArray());
      if (hit && hit.distance < (nearest?.distance ?? Infinity)) nearest = {...hit, slot};
    });
    return nearest;
  }

  /** The least and the greatest corner of a box in whole mm about what of this scan's mesh is on the canvas; null for nothing. */
  seen() {
    const {mesh, object} = this.slots[0]?.full ?? this.slots[0]?.coarse ?? {};
    const {array, width} = mesh?.attributes.POSITION ?? {array: []};
    const box = new Box3();
    const [point, at] = [new Vector3(), new Vector3()];
    for (let start = 0; start < array.length; start += width) {
      at.copy(point.fromArray(array, start).applyMatrix4(object.matrix)).project(this.camera);
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
