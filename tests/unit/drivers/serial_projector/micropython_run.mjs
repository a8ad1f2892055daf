// Runs a Python script from stdin in MicroPython's own interpreter, with the files of a folder beside it.
//
// node micropython_run.mjs PACKAGE FOLDER < SCRIPT
import { readdirSync, readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [, , packageFolder, folder] = process.argv;
const { loadMicroPython } = await import(pathToFileURL(`${packageFolder}/micropython.mjs`));
const interpreter = await loadMicroPython({ heapsize: 192 * 1024, stdout: (line) => console.log(line) });
for (const name of readdirSync(folder)) {
  if (name.endsWith(".py") && name !== "__init__.py") {
    interpreter.FS.writeFile(`/${name}`, readFileSync(`${folder}/${name}`, "utf8"));
  }
}
try {
  interpreter.runPython(`import sys\nsys.path.append("/")\n`);
  interpreter.runPython(readFileSync(0, "utf8"));
} catch (error) {
  console.error(error.message);
  process.exit(1);
}
