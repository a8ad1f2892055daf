// What is measured on a mesh, each with its standard deviation: distances, planes, balls, cylinders, sections. Nothing here draws.
import {cross, dot} from "./vectors.js";

/** A standard deviation that is not known, as it is stored. */
const UNKNOWN = 65535;
/** Of a patch's vertices so many are fitted at most. */
const MOST_POINTS = 5000;
/** Neighbours err alike: a patch counts as so many independent points, however many vertices it has. */
const INDEPENDENT = 16;
/** Vertices that lie further off than so many standard deviations of all are left out. */
const OUTLYING = 3;
const ROUNDS = 8;
const STEPS = 60;
const DIRECTIONS = 600;
const LEAST_POINTS = 20;

const add = (a, b, factor = 1) => a.map((each, axis) => each + factor * b[axis]);
const unit = (a) => a.map((each) => each / Math.hypot(...a));
const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
const median = (values) => [...values].sort((a, b) => a - b)[values.length >> 1];

/** Two unit vectors at right angles to a unit vector and to each other. */
function across(normal) {
  const least = normal.map(Math.abs).indexOf(Math.min(...normal.map(Math.abs)));
  const first = unit(cross(normal, [0, 1, 2].map((axis) => Number(axis === least))));
  return [first, cross(normal, first)];
}

/** The inverse of a symmetric, positive matrix, rows of numbers; null where it has none (Gauss and Jordan, with pivots). */
function inverse(matrix) {
  const size = matrix.length;
  const rows = matrix.map((row, at) => [...row, ...row.map((_, column) => Number(column === at))]);
  for (let at = 0; at < size; at += 1) {
    let best = at;
    for (let row = at + 1; row < size; row += 1) if (Math.abs(rows[row][at]) > Math.abs(rows[best][at])) best = row;
    [rows[at], rows[best]] = [rows[best], rows[at]];
    const pivot = rows[at][at];
    if (!(Math.abs(pivot) > 1e-300)) return null;
    rows[at] = rows[at].map((each) => each / pivot);
    for (let row = 0; row < size; row += 1) if (row !== at) rows[row] = rows[row].map((each, column) => each - rows[row][at] * rows[at][column]);
  }
  return rows.map((row) => row.slice(size));
}

const times = (matrix, vector) => matrix.map((row) => row.reduce((sum, each, at) => sum + each * vector[at], 0));

/** The distance of two points {pointMm, sigmaMm}; σ as if each erred along the line. */
export const distance = (a, b) => ({valueMm: apart(a.pointMm, b.pointMm), sigmaMm: Math.hypot(a.sigmaMm, b.sigmaMm)});

/**
 * What the true length of a measured distance says of the scale: the factor of all lengths, and its relative σ, by the two points, by where they were clicked
 * (`clickedMm` of each) and by that of the length itself.
 */
export function scaleBy({valueMm, sigmaMm, clickedMm}, trueMm, trueSigmaMm = 0) {
  const sigma = Math.hypot(...[sigmaMm, ...clickedMm].map((mm) => Number.isFinite(mm) ? mm / valueMm : 0), trueSigmaMm / trueMm);
  return {factor: trueMm / valueMm, sigma: Math.min(Math.max(sigma, 1e-5), 1)};
}

/** The vertices within a ball, in mm, and their σ: {points: [[x, y, z]], sigmas}. σ is NaN where it is not known. */
export function patch(mesh, centreMm, radiusMm) {
  const {array, width} = mesh.attributes.POSITION;
  const sigma = mesh.attributes._SIGMA;
  const [x, y, z] = centreMm.map((mm, axis) => (mm - mesh.originMm[axis]) / mesh.stepMm);
  const most = (radiusMm / mesh.stepMm) ** 2;
  const inside = [];
  for (let vertex = 0, at = 0; vertex < mesh.vertices; vertex += 1, at += width)
    if ((array[at] - x) ** 2 + (array[at + 1] - y) ** 2 + (array[at + 2] - z) ** 2 <= most) inside.push(vertex);
  const every = Math.ceil(inside.length / MOST_POINTS) || 1;
  const chosen = inside.filter((_, at) => at % every === 0);
  return {
    points: chosen.map((vertex) => [0, 1, 2].map((axis) => mesh.originMm[axis] + mesh.stepMm * array[vertex * width + axis])),
    sigmas: chosen.map((vertex) => {
      const stored = sigma.array[vertex * sigma.width];
      return stored === UNKNOWN ? NaN : Math.max(stored, 1) * mesh.sigmaStepMm;
    }),
  };
}

/**
 * Forms by name: `begin(points)` gives a first guess; `of(form, point)` the point's distance from it and how that changes with each parameter;
 * `moved(form, step)` the form with its parameters changed by `step`.
 */
const FORMS = {
  plane: {
    begin: (points) => ({centre: mean(points), normal: flattest(points)}),
    of({centre, normal}, point) {
      const from = add(point, centre, -1);
      return [dot(from, normal), [-1, ...across(normal).map((axis) => dot(from, axis))]];
    },
    moved: ({centre, normal}, [off, ...tilts]) => ({centre: add(centre, normal, off), normal: tilted(normal, tilts)}),
  },
  sphere: {
    begin(points) {
      // |p|² = 2 c p + (r² - |c|²) is linear (Coope 1993, "Circle fitting by linear and nonlinear least squares").
      const middle = mean(points);
      const found = linear(points.map((point) => [...add(point, middle, -1), 1]), points.map((point) => apart(point, middle) ** 2));
      if (!found) return null;
      const centre = found.slice(0, 3).map((each) => each / 2);
      return {centre: add(middle, centre), radius: Math.sqrt(Math.max(found[3] + dot(centre, centre), 0))};
    },
    of({centre, radius}, point) {
      const away = apart(point, centre) || 1;
      return [away - radius, [...add(point, centre, -1).map((each) => -each / away), -1]];
    },
    moved: ({centre, radius}, [x, y, z, more]) => ({centre: add(centre, [x, y, z]), radius: radius + more}),
  },
  cylinder: {
    begin(points) {
      const middle = mean(points);
      const few = points.filter((_, at) => at % (Math.ceil(points.length / 300) || 1) === 0).map((point) => add(point, middle, -1));
      let best = null;
      for (let at = 0; at < DIRECTIONS; at += 1) {
        // Evenly over half a ball (Saff and Kuijlaars 1997, "Distributing many points on a sphere").
        const height = (at + 0.5) / DIRECTIONS;
        const turn = at * Math.PI * (3 - Math.sqrt(5));
        const axis = [Math.sqrt(1 - height ** 2) * Math.cos(turn), Math.sqrt(1 - height ** 2) * Math.sin(turn), height];
        const [first, second] = across(axis);
        const flat = few.map((point) => [dot(point, first), dot(point, second)]);
        const found = linear(flat.map(([x, y]) => [x, y, 1]), flat.map(([x, y]) => x * x + y * y));
        if (!found) continue;
        const [x, y] = [found[0] / 2, found[1] / 2];
        const radius = Math.sqrt(Math.max(found[2] + x * x + y * y, 0));
        const off = flat.reduce((sum, point) => sum + (Math.hypot(point[0] - x, point[1] - y) - radius) ** 2, 0);
        if (!best || off < best.off) best = {off, centre: add(add(middle, first, x), second, y), axis, radius};
      }
      return best;
    },
    of({centre, axis, radius}, point) {
      const from = add(point, centre, -1);
      const along = dot(from, axis);
      const out = add(from, axis, -along);
      const away = Math.hypot(...out) || 1;
      const [first, second] = across(axis).map((each) => -dot(out, each) / away);
      return [away - radius, [first, second, first * along, second * along, -1]];
    },
    moved({centre, axis, radius}, [right, up, tiltRight, tiltUp, more]) {
      const [first, second] = across(axis);
      return {centre: add(add(centre, first, right), second, up), axis: tilted(axis, [tiltRight, tiltUp]), radius: radius + more};
    },
  },
};

const mean = (points) => points.reduce((sum, point) => add(sum, point), [0, 0, 0]).map((each) => each / points.length);
const tilted = (axis, tilts) => unit(across(axis).reduce((sum, each, at) => add(sum, each, tilts[at]), axis));

/** The direction in which points spread least, by inverse iteration. */
function flattest(points) {
  const middle = mean(points);
  const spread = [0, 1, 2].map(() => [0, 0, 0]);
  for (const point of points) {
    const from = add(point, middle, -1);
    for (let row = 0; row < 3; row += 1) for (let column = 0; column < 3; column += 1) spread[row][column] += from[row] * from[column];
  }
  const size = spread[0][0] + spread[1][1] + spread[2][2];
  const inverted = inverse(spread.map((row, at) => row.map((each, column) => each + (at === column ? size * 1e-12 : 0))));
  let normal = unit([0.3, 0.5, 0.8]);
  for (let step = 0; step < STEPS; step += 1) normal = unit(times(inverted, normal));
  return normal;
}

/** What solves rows x = values in the sense of least squares; null where nothing does. */
function linear(rows, values) {
  const size = rows[0].length;
  const squared = Array.from({length: size}, () => new Array(size).fill(0));
  const right = new Array(size).fill(0);
  rows.forEach((row, at) => {
    for (let i = 0; i < size; i += 1) {
      right[i] += row[i] * values[at];
      for (let j = 0; j < size; j += 1) squared[i][j] += row[i] * row[j];
    }
  });
  const inverted = inverse(squared);
  return inverted && times(inverted, right);
}

/** One step of weighted least squares from a form: {step, covariance, off: the weighted mean of squares}, null where it is not determined. */
function adjusted(kind, form, {points, sigmas}) {
  let squared = null;
  let right = null;
  let sum = 0;
  points.forEach((point, at) => {
    const weight = 1 / sigmas[at] ** 2;
    const [off, slopes] = kind.of(form, point);
    squared ??= slopes.map(() => new Array(slopes.length).fill(0));
    right ??= new Array(slopes.length).fill(0);
    sum += weight * off * off;
    for (let i = 0; i < slopes.length; i += 1) {
      right[i] -= weight * slopes[i] * off;
      for (let j = 0; j < slopes.length; j += 1) squared[i][j] += weight * slopes[i] * slopes[j];
    }
  });
  const covariance = inverse(squared);
  return covariance && {step: times(covariance, right), covariance, off: sum / points.length};
}

/**
 * Fit a `plane`, `sphere` or `cylinder` to a patch by least squares of distances, weighted by σ; what lies off is left out. Returns the form, `points` that were
 * fitted, `rmsMm` of their distances and the `covariance` of its parameters; null where the patch does not determine it. Where σ is not known, it is NaN.
 *
 * The covariance is that of `INDEPENDENT` points of the patch's σ, and larger where the patch lies further off than its σ says.
 */
export function fit(name, {points, sigmas}) {
  const kind = FORMS[name];
  const known = sigmas.every(Number.isFinite);
  let used = {points, sigmas: known ? sigmas : sigmas.map(() => 1)};
  if (points.length < LEAST_POINTS) return null;
  let form = kind.begin(points);
  let last = null;
  for (let round = 0; form && round < ROUNDS; round += 1) {
    for (let step = 0; step < STEPS; step += 1) {
      last = adjusted(kind, form, used);
      if (!last) return null;
      const next = kind.moved(form, last.step);
      if (!(adjusted(kind, next, used)?.off < last.off)) break;
      form = next;
    }
    const off = points.map((point) => Math.abs(kind.of(form, point)[0]));
    const limit = OUTLYING * Math.max(1.4826 * median(off), known ? median(sigmas) : 0);
    const kept = points.flatMap((_, at) => off[at] <= limit ? [at] : []);
    if (kept.length === used.points.length || kept.length < LEAST_POINTS) break;
    used = {points: kept.map((at) => points[at]), sigmas: kept.map((at) => known ? sigmas[at] : 1)};
  }
  if (!form || !last) return null;
  const rmsMm = Math.sqrt(used.points.reduce((sum, point) => sum + kind.of(form, point)[0] ** 2, 0) / used.points.length);
  const larger = known ? Math.max(last.off, 1) * Math.max(used.points.length / INDEPENDENT, 1) : NaN;
  return {...form, points: used.points.length, rmsMm, covariance: last.covariance.map((row) => row.map((each) => each * larger))};
}

/** How far a point {pointMm, sigmaMm} is from a fitted plane, its foot there, and σ of both together. */
export function pointToPlane({pointMm, sigmaMm}, plane) {
  const [off, slopes] = FORMS.plane.of(plane, pointMm);
  return {valueMm: Math.abs(off), footMm: add(pointMm, plane.normal, -off), sigmaMm: Math.hypot(sigmaMm, Math.sqrt(dot(slopes, times(plane.covariance, slopes))))};
}

/** The radius of a fitted ball or cylinder. */
export const radius = ({radius: valueMm, covariance}) => ({valueMm, sigmaMm: Math.sqrt(covariance.at(-1).at(-1))});

/**
 * Cut the mesh by the plane through two hits of `firstHit` that holds the direction `along`, mm, and follow the surface from the one to the other: `line`, its points
 * in mm, and its length. Points that lie within 2 σ of a straight line are noise and do not lengthen it. Null where the surface has a gap on the way.
 */
export function section(mesh, a, b, along) {
  const inside = a.pointMm.map((mm, axis) => (mm - mesh.originMm[axis]) / mesh.stepMm);
  const normal = unit(cross(add(b.pointMm, a.pointMm, -1), along));
  const cut = crossed(mesh, normal, dot(inside, normal));
  const ways = a.corner === b.corner ? [[]] : (cut.edges.get(a.corner) ?? []).map((edge) => walk(cut, a.corner, edge, b.corner)).filter((each) => each !== null);
  if (ways.length === 0) return null;
  const lines = ways.map((edges) => [a, ...edges.map((edge) => crossing(mesh, normal, dot(inside, normal), edge)), b]).map((line) => ({line, valueMm: lengthOf(line)}));
  const {line} = lines.reduce((best, each) => each.valueMm < best.valueMm ? each : best);
  const sigmas = line.map(({sigmaMm}) => sigmaMm).filter(Number.isFinite);
  const kept = simple(line, 2 * (sigmas.length ? median(sigmas) : mesh.stepMm));
  return {line: kept.map(({pointMm}) => pointMm), valueMm: lengthOf(kept), sigmaMm: sigmaOf(kept)};
}

const lengthOf = (line) => line.reduce((sum, {pointMm}, at) => sum + (at ? apart(pointMm, line[at - 1].pointMm) : 0), 0);

/** σ of a line's length: each point moves it by as much as the line bends there. */
function sigmaOf(line) {
  const ahead = line.slice(1).map(({pointMm}, at) => unit(add(pointMm, line[at].pointMm, -1)));
  const variances = line.map(({sigmaMm}, at) => (sigmaMm * Math.hypot(...add(ahead[at - 1] ?? [0, 0, 0], ahead[at] ?? [0, 0, 0], -1))) ** 2);
  return Math.sqrt(variances.reduce((sum, each) => sum + each, 0));
}

/** Triangles that a plane cuts: `edges` of each (by the place of its first corner), `triangles` of each edge. An edge is a number made of its two vertices. */
function crossed(mesh, normal, offset) {
  const {array, width} = mesh.attributes.POSITION;
  const {corners} = mesh;
  const [nx, ny, nz] = normal;
  const above = new Uint8Array(mesh.vertices);
  for (let vertex = 0, at = 0; vertex < mesh.vertices; vertex += 1, at += width)
    above[vertex] = nx * array[at] + ny * array[at + 1] + nz * array[at + 2] >= offset ? 1 : 0;
  const edges = new Map();
  const triangles = new Map();
  for (let corner = 0; corner < corners.length; corner += 3) {
    const three = [corners[corner], corners[corner + 1], corners[corner + 2]];
    const sum = above[three[0]] + above[three[1]] + above[three[2]];
    if (sum === 0 || sum === 3) continue;
    const cut = [0, 1, 2].flatMap((at) => {
      const [from, to] = [three[at], three[(at + 1) % 3]];
      return above[from] === above[to] ? [] : [Math.min(from, to) * mesh.vertices + Math.max(from, to)];
    });
    edges.set(corner, cut);
    for (const edge of cut) triangles.set(edge, [...triangles.get(edge) ?? [], corner]);
  }
  return {edges, triangles};
}

/** The edges that are crossed on the way from a triangle, first over `edge`, to another one; null if the way ends before. */
function walk({edges, triangles}, from, edge, to) {
  const way = [edge];
  const been = new Set([from]);
  for (let at = from; ;) {
    const next = triangles.get(way.at(-1)).find((each) => each !== at && !been.has(each));
    if (next === undefined) return null;
    if (next === to) return way;
    been.add(next);
    way.push(edges.get(next).find((each) => each !== way.at(-1)));
    at = next;
  }
}

/** Where a plane cuts an edge: {pointMm, sigmaMm}. */
function crossing(mesh, normal, offset, edge) {
  const {array, width} = mesh.attributes.POSITION;
  const sigma = mesh.attributes._SIGMA;
  const ends = [Math.floor(edge / mesh.vertices), edge % mesh.vertices];
  const [a, b] = ends.map((vertex) => [0, 1, 2].map((axis) => array[vertex * width + axis]));
  const [before, after] = [a, b].map((point) => dot(point, normal) - offset);
  const share = before / (before - after);
  const [sa, sb] = ends.map((vertex) => sigma.array[vertex * sigma.width]);
  return {
    pointMm: a.map((each, axis) => mesh.originMm[axis] + mesh.stepMm * (each + share * (b[axis] - each))),
    sigmaMm: Math.max(sa, sb) === UNKNOWN ? NaN : mesh.sigmaStepMm * (sa + share * (sb - sa)),
  };
}

/** The points of a line that are further than a limit from what is straight between those before and behind (Douglas and Peucker 1973). */
function simple(line, limitMm) {
  const kept = new Set([0, line.length - 1]);
  const open = [[0, line.length - 1]];
  while (open.length) {
    const [first, last] = open.pop();
    const [from, to] = [line[first].pointMm, line[last].pointMm];
    const along = apart(from, to);
    let [most, at] = [limitMm, null];
    for (let each = first + 1; each < last; each += 1) {
      const away = add(line[each].pointMm, from, -1);
      const off = along ? Math.hypot(...cross(away, add(to, from, -1))) / along : Math.hypot(...away);
      if (off > most) [most, at] = [off, each];
    }
    if (at === null) continue;
    kept.add(at);
    open.push([first, at], [at, last]);
  }
  return line.filter((_, at) => kept.has(at));
}
