// A worker: how far each vertex of a mesh is from another mesh, with the sign of the side. Message {of, from}, answer {values: Float32Array}.
import {cross, dot} from "./vectors.js";

/** Cells are so many times as wide as the other mesh's vertices lie apart, and so many of them are looked at on each side. */
const CELL_SPACINGS = 1.5;
const REACH_CELLS = 5;
/** Where the nearest point is this far aside of the normal, it is on the other mesh's border: there is nothing to compare with. */
const ASIDE = 0.5;
/** What is not known, or too far away. */
export const NOT_KNOWN = 65535;

/** {positions: Float32Array of x, y, z in mm, corners}: positions of a mesh of glb.js that may be sent to a worker. */
export function plainMesh({attributes, corners, originMm, stepMm, vertices}) {
  const {array, width} = attributes.POSITION;
  const positions = new Float32Array(3 * vertices);
  for (let vertex = 0; vertex < vertices; vertex += 1)
    for (let axis = 0; axis < 3; axis += 1) positions[3 * vertex + axis] = originMm[axis] + stepMm * array[vertex * width + axis];
  return {positions, corners: corners ? Uint32Array.from(corners) : new Uint32Array(0)};
}

/**
 * The signed distance, mm, of each vertex of `of` from the nearest triangle of `from` about its nearest vertex, positive on the side that the triangles face away from
 * the scan's z; NOT_KNOWN further away than the reach, and beside the other's border. Returns {values, reachMm}.
 */
export function deviations(of, from) {
  const {positions: points, corners} = from;
  const count = points.length / 3;
  const values = new Float32Array(of.positions.length / 3).fill(NOT_KNOWN);
  if (corners.length === 0) return {values, reachMm: 0};
  const cellMm = CELL_SPACINGS * spacing(points, corners);
  const {least, wide, high} = extent(points, cellMm);
  const cellAt = (x, y, z) => Math.floor((x - least[0]) / cellMm) + wide * (Math.floor((y - least[1]) / cellMm) + high * Math.floor((z - least[2]) / cellMm));
  const cells = grouped(count, (vertex) => cellAt(points[3 * vertex], points[3 * vertex + 1], points[3 * vertex + 2]));
  const fans = fansOf(count, corners);
  const shells = Array.from({length: REACH_CELLS + 1}, (_, ring) => shell(ring, wide, high));
  for (let at = 0; at < values.length; at += 1) {
    const [x, y, z] = [of.positions[3 * at], of.positions[3 * at + 1], of.positions[3 * at + 2]];
    const home = cellAt(x, y, z);
    let best = Infinity;
    let nearest = -1;
    // Nothing in a ring of cells is nearer than its inner border.
    const inside = Math.min(...[x, y, z].map((mm, axis) => {
      const share = (((mm - least[axis]) / cellMm) % 1) * cellMm;
      return Math.min(share, cellMm - share);
    }));
    for (let ring = 0; ring <= REACH_CELLS && (ring === 0 || best > ((ring - 1) * cellMm + inside) ** 2); ring += 1) {
      for (const step of shells[ring]) {
        const cell = cells.places.get(home + step);
        if (cell === undefined) continue;
        for (let each = cells.starts[cell]; each < cells.starts[cell + 1]; each += 1) {
          const vertex = cells.members[each];
          const away = (points[3 * vertex] - x) ** 2 + (points[3 * vertex + 1] - y) ** 2 + (points[3 * vertex + 2] - z) ** 2;
          if (away < best) [best, nearest] = [away, vertex];
        }
      }
    }
    if (nearest >= 0) values[at] = offTriangles(points, corners, fans, nearest, [x, y, z]);
  }
  return {values, reachMm: REACH_CELLS * cellMm};
}

/** How far vertices lie apart, mm: the mean side of some triangles. */
function spacing(points, corners) {
  let sum = 0;
  let sides = 0;
  for (let at = 0; at < corners.length; at += 3 * Math.ceil(corners.length / 30_000)) {
    const [a, b] = [3 * corners[at], 3 * corners[at + 1]];
    sum += Math.hypot(points[a] - points[b], points[a + 1] - points[b + 1], points[a + 2] - points[b + 2]);
    sides += 1;
  }
  return sum / sides || 1;
}

/** The least corner, and how many cells there are across and down, with room for those beside. */
function extent(points, cellMm) {
  const least = [Infinity, Infinity, Infinity];
  const most = [-Infinity, -Infinity, -Infinity];
  for (let at = 0; at < points.length; at += 1) {
    least[at % 3] = Math.min(least[at % 3], points[at]);
    most[at % 3] = Math.max(most[at % 3], points[at]);
  }
  const room = (2 * REACH_CELLS + 2) * cellMm;
  const [wide, high] = [0, 1].map((axis) => Math.ceil((most[axis] - least[axis] + 2 * room) / cellMm));
  return {least: least.map((each) => each - room), wide, high};
}

/** Members of each group, by the number that `group` gives each of them. */
function grouped(count, group) {
  const places = new Map();
  const own = new Int32Array(count);
  for (let each = 0; each < count; each += 1) {
    const key = group(each);
    let place = places.get(key);
    if (place === undefined) places.set(key, (place = places.size));
    own[each] = place;
  }
  return {places, ...listed(own, places.size, count, (each) => each)};
}

/** For each vertex the triangles that it is a corner of. */
const fansOf = (count, corners) => listed(corners, count, corners.length, (corner) => corner - (corner % 3));

function listed(own, groups, count, member) {
  const starts = new Uint32Array(groups + 1);
  for (let each = 0; each < count; each += 1) starts[own[each] + 1] += 1;
  for (let group = 0; group < groups; group += 1) starts[group + 1] += starts[group];
  const filled = starts.slice();
  const members = new Uint32Array(count);
  for (let each = 0; each < count; each += 1) {
    members[filled[own[each]]] = member(each);
    filled[own[each]] += 1;
  }
  return {starts, members};
}

/** Steps to the cells that are `ring` away. */
function shell(ring, wide, high) {
  const steps = [];
  for (let z = -ring; z <= ring; z += 1)
    for (let y = -ring; y <= ring; y += 1)
      for (let x = -ring; x <= ring; x += 1) if (Math.max(Math.abs(x), Math.abs(y), Math.abs(z)) === ring) steps.push(x + wide * (y + high * z));
  return steps;
}

function offTriangles(points, corners, {starts, members}, vertex, point) {
  let best = Infinity;
  let value = NOT_KNOWN;
  for (let each = starts[vertex]; each < starts[vertex + 1]; each += 1) {
    const [a, b, c] = [0, 1, 2].map((at) => 3 * corners[members[each] + at]).map((at) => [points[at], points[at + 1], points[at + 2]]);
    const normal = cross(less(b, a), less(c, a));
    const size = Math.hypot(...normal);
    if (!size) continue;
    const away = less(point, nearestOn(a, b, c, point));
    const square = dot(away, away);
    if (square >= best) continue;
    best = square;
    const along = dot(away, normal) / size;
    value = square - along * along > ASIDE ** 2 * square && square > 1e-12 ? NOT_KNOWN : Math.sign(along) * Math.sqrt(square);
  }
  return value;
}

const less = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const between = (a, b, share) => a.map((each, axis) => each + share * (b[axis] - each));

/** The point of a triangle that is nearest to a point (Ericson 2005, "Real-Time Collision Detection", section 5.1.5). */
function nearestOn(a, b, c, point) {
  const [ab, ac] = [less(b, a), less(c, a)];
  const [ap, bp, cp] = [a, b, c].map((each) => less(point, each));
  const [d1, d2, d3, d4, d5, d6] = [dot(ab, ap), dot(ac, ap), dot(ab, bp), dot(ac, bp), dot(ab, cp), dot(ac, cp)];
  if (d1 <= 0 && d2 <= 0) return a;
  if (d3 >= 0 && d4 <= d3) return b;
  const vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return between(a, b, d1 / (d1 - d3));
  if (d6 >= 0 && d5 <= d6) return c;
  const vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return between(a, c, d2 / (d2 - d6));
  const va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 >= d3 && d5 >= d6) return between(b, c, (d4 - d3) / (d4 - d3 + (d5 - d6)));
  const sum = va + vb + vc;
  return a.map((each, axis) => each + (vb / sum) * ab[axis] + (vc / sum) * ac[axis]);
}

if (globalThis.WorkerGlobalScope) globalThis.onmessage = ({data: {of, from}}) => postMessage(deviations(of, from));
