// Measures on a mesh as the page does. Arguments: the page's modules, view.glb; standard input: {name: {kind, rays: [[from, to], …], patch_mm}}, all in mm.
import {readFileSync} from "node:fs";

const [modules, path] = process.argv.slice(2);
const {firstHit, readMesh} = await import(`${modules}/glb.js`);
const {distance, fit, patch, pointToPlane, radius, section} = await import(`${modules}/measure.js`);
const mesh = readMesh(new Uint8Array(readFileSync(path)).buffer);

function hit([from, to]) {
  const [start, end] = [from, to].map((point) => point.map((mm, axis) => (mm - mesh.originMm[axis]) / mesh.stepMm));
  return firstHit(mesh, start, end.map((each, axis) => each - start[axis]));
}

function measured({kind, rays, patch_mm}) {
  const [first, second] = rays.map(hit);
  if (kind === "distance") return distance(first, second);
  if (kind === "section") return section(mesh, first, second, rays[1][1].map((mm, axis) => mm - rays[1][0][axis]));
  const form = fit(kind, patch(mesh, first.pointMm, patch_mm));
  return kind === "plane" ? pointToPlane(second, form) : radius(form);
}

const asked = JSON.parse(readFileSync(0, "utf-8"));
console.log(JSON.stringify(Object.fromEntries(Object.entries(asked).map(([name, each]) => {
  const found = measured(each);
  return [name, found && [found.valueMm, found.sigmaMm]];
}))));
