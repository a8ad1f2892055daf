// Reads the meshes that slrig writes for this page (slrig/scan/formats.py): arrays over the bytes as they came.
import {Problem} from "./service.js";

const MAGIC = 0x46546c67;
const TREE_AT = 20;
const CHUNK_HEAD = 8;
const ARRAYS = {5120: Int8Array, 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array};
const COMPONENTS = {SCALAR: 1, VEC3: 3, VEC4: 4};
/** A standard deviation or a stripe that is not known. */
const UNKNOWN = 65535;

/** Fetch a mesh; `told` gets the share that is here. Throws Problem, and AbortError when `signal` says so. */
export async function fetchMesh(path, signal, told = () => {}) {
  const response = await fetch(path, {signal}).catch((error) => {
    throw signal.aborted ? error : new Problem(0, {title: "No answer", detail: "The mesh did not come. Load the page again when the service answers."});
  });
  if (!response.ok) throw new Problem(response.status, await response.json().catch(() => ({})));
  return readMesh(await bytesOf(response, told));
}

/** The body, in one buffer from the start where its length is known: a mesh of 40 MB is then in memory once. */
async function bytesOf(response, told) {
  const length = Number(response.headers.get("Content-Length"));
  if (!length || response.headers.get("Content-Encoding")) return response.arrayBuffer();
  const whole = new Uint8Array(length);
  const reader = response.body.getReader();
  let filled = 0;
  for (let piece = await reader.read(); !piece.done; piece = await reader.read()) {
    whole.set(piece.value, filled);
    filled += piece.value.length;
    told(filled / length);
  }
  return whole.buffer;
}

/**
 * The mesh in a GLB: `vertices` and `triangles` count; `attributes` by glTF's names, each {array, width, normalized}, `width` the
 * elements from one vertex to the next; `corners` of the triangles, null where there are none; `min`, `max` of the stored positions. A stored
 * position p is `originMm + stepMm * p` in the scan's axes.
 */
export function readMesh(buffer) {
  const head = new DataView(buffer);
  if (head.getUint32(0, true) !== MAGIC) throw new Problem(200, {title: "Not a mesh", detail: "The file is no binary glTF."});
  const treeLength = head.getUint32(12, true);
  const tree = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, TREE_AT, treeLength)));
  const start = TREE_AT + treeLength + CHUNK_HEAD;
  const {origin_mm: originMm, step_mm: stepMm, sigma_step_mm: sigmaStepMm} = tree.nodes[0].extras;
  const stored = (number) => {
    const accessor = tree.accessors[number];
    const {byteOffset, byteLength, byteStride} = tree.bufferViews[accessor.bufferView];
    const Kind = ARRAYS[accessor.componentType];
    const size = Kind.BYTES_PER_ELEMENT;
    return {
      array: new Kind(buffer, start + byteOffset, byteLength / size),
      width: byteStride ? byteStride / size : COMPONENTS[accessor.type],
      normalized: accessor.normalized ?? false,
    };
  };
  const primitive = tree.meshes?.[0].primitives[0] ?? {attributes: {}};
  const attributes = Object.fromEntries(Object.entries(primitive.attributes).map(([name, number]) => [name, stored(number)]));
  const corners = primitive.indices === undefined ? null : stored(primitive.indices).array;
  const position = tree.accessors?.[primitive.attributes.POSITION] ?? {count: 0, min: [0, 0, 0], max: [0, 0, 0]};
  const {count: vertices, min, max} = position;
  return {originMm, stepMm, sigmaStepMm, vertices, triangles: (corners?.length ?? 0) / 3, attributes, corners, min, max};
}

/**
 * Where a ray first meets the mesh (Möller and Trumbore 1997, "Fast, minimum storage ray/triangle intersection"): {distance, pointMm, sigmaMm, corner: the
 * first of the triangle's}, or null.
 * `from` and `along` are in stored positions. All triangles are tried: 1.7 million take some 50 ms, and no tree has to be kept.
 */
export function firstHit(mesh, from, along) {
  const {corners} = mesh;
  const {array: at, width} = mesh.attributes.POSITION ?? {};
  if (!corners) return null;
  const [ox, oy, oz] = from;
  const [dx, dy, dz] = along;
  let best = Infinity;
  let found = null;
  for (let c = 0; c < corners.length; c += 3) {
    const a = corners[c] * width, b = corners[c + 1] * width, d = corners[c + 2] * width;
    const ax = at[a], ay = at[a + 1], az = at[a + 2];
    const ex = at[b] - ax, ey = at[b + 1] - ay, ez = at[b + 2] - az;
    const fx = at[d] - ax, fy = at[d + 1] - ay, fz = at[d + 2] - az;
    const px = dy * fz - dz * fy, py = dz * fx - dx * fz, pz = dx * fy - dy * fx;
    const volume = ex * px + ey * py + ez * pz;
    if (volume === 0) continue;
    const sx = ox - ax, sy = oy - ay, sz = oz - az;
    const u = (sx * px + sy * py + sz * pz) / volume;
    if (u < 0 || u > 1) continue;
    const qx = sy * ez - sz * ey, qy = sz * ex - sx * ez, qz = sx * ey - sy * ex;
    const v = (dx * qx + dy * qy + dz * qz) / volume;
    if (v < 0 || u + v > 1) continue;
    const distance = (fx * qx + fy * qy + fz * qz) / volume;
    if (distance <= 0 || distance >= best) continue;
    best = distance;
    found = [c, u, v];
  }
  if (!found) return null;
  const pointMm = mesh.originMm.map((origin, axis) => origin + mesh.stepMm * (from[axis] + best * along[axis]));
  return {distance: best, pointMm, sigmaMm: sigmaAt(mesh, ...found), corner: found[0]};
}

/** The standard deviation within the triangle whose corners begin at `corner`, mm; NaN where one of theirs is not known. */
function sigmaAt(mesh, corner, u, v) {
  const {array, width} = mesh.attributes._SIGMA;
  const [a, b, c] = [0, 1, 2].map((each) => array[mesh.corners[corner + each] * width]);
  return Math.max(a, b, c) === UNKNOWN ? NaN : mesh.sigmaStepMm * (a + u * (b - a) + v * (c - a));
}
