// What a calibrated camera sees of a mesh: points in its image, the ray of a pixel, and which vertices are in its sight.

const STEPS = 30;
/** A vertex this much further than the nearest one beside it, over its distance, is hidden. */
const HIDDEN = 0.004;
/** Vertices are compared in cells of so many pixels: the mesh has about one vertex for each pixel or two. */
const CELL_PX = 3;
/** Of a vertex that a camera does not see. */
export const UNSEEN = 255;

/** Pixel (column, row) of a point in mm, and its depth before the camera, mm; null behind it. `device` as in calibration.json; the lens is Brown's (1966) in OpenCV's form. */
export function project({matrix, distortion, rotation, translation_mm: shift}, [x, y, z]) {
  const [right, down, away] = rotation.map((row, at) => row[0] * x + row[1] * y + row[2] * z + shift[at]);
  if (away <= 0) return null;
  const [u, v] = bent(distortion, right / away, down / away);
  return [matrix[0][0] * u + matrix[0][1] * v + matrix[0][2], matrix[1][1] * v + matrix[1][2], away];
}

function bent([k1, k2, p1, p2, k3], x, y) {
  const r2 = x * x + y * y;
  const radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
  return [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y];
}

/** The ray of a pixel (column, row): {fromMm, along}. */
export function rayOf({matrix, distortion, rotation, translation_mm: shift}, [column, row]) {
  const v = (row - matrix[1][2]) / matrix[1][1];
  const u = (column - matrix[0][2] - matrix[0][1] * v) / matrix[0][0];
  let [x, y] = [u, v];
  for (let step = 0; step < STEPS; step += 1) {
    const [a, b] = bent(distortion, x, y);
    [x, y] = [x + u - a, y + v - b];
  }
  const turned = (vector) => [0, 1, 2].map((axis) => rotation[0][axis] * vector[0] + rotation[1][axis] * vector[1] + rotation[2][axis] * vector[2]);
  return {fromMm: turned(shift).map((each) => -each), along: turned([x, y, 1])};
}

/** Of each vertex the value that a camera's map {width, height, codes} has at its pixel; UNSEEN where the camera does not see it. */
export function valuesAt(mesh, device, {width, height, codes}) {
  const {array, width: step} = mesh.attributes.POSITION;
  const {originMm, stepMm, vertices} = mesh;
  const wide = Math.ceil(width / CELL_PX);
  const nearest = new Float32Array(wide * Math.ceil(height / CELL_PX)).fill(Infinity);
  const pixels = new Int32Array(vertices).fill(-1);
  const depths = new Float32Array(vertices);
  for (let vertex = 0, at = 0; vertex < vertices; vertex += 1, at += step) {
    const [u, v, away] = project(device, [originMm[0] + stepMm * array[at], originMm[1] + stepMm * array[at + 1], originMm[2] + stepMm * array[at + 2]]) ?? [-1, -1, 0];
    const [column, row] = [Math.round(u), Math.round(v)];
    if (column < 0 || row < 0 || column >= width || row >= height) continue;
    pixels[vertex] = row * width + column;
    depths[vertex] = away;
    const cell = Math.floor(row / CELL_PX) * wide + Math.floor(column / CELL_PX);
    if (away < nearest[cell]) nearest[cell] = away;
  }
  return Uint8Array.from(pixels, (pixel, vertex) => {
    if (pixel < 0) return UNSEEN;
    const cell = Math.floor(Math.floor(pixel / width) / CELL_PX) * wide + Math.floor((pixel % width) / CELL_PX);
    return depths[vertex] > nearest[cell] * (1 + HIDDEN) ? UNSEEN : codes[pixel];
  });
}
