// Runs a Python script in MicroPython's own interpreter, with the files of a folder beside it. The script's module
// `channel` is stdin and stdout: give(byte), take() -> byte.
//
// node micropython.mjs PACKAGE FOLDER SCRIPT
import { readdirSync, readFileSync, readSync, writeSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [, , packageFolder, folder, script] = process.argv;
const { loadMicroPython } = await import(pathToFileURL(`${packageFolder}/micropython.mjs`));
const interpreter = await loadMicroPython({ heapsize: 192 * 1024, stdout: (line) => console.error(line) });
let given = [];
let taken = Buffer.alloc(0);
interpreter.registerJsModule("channel", {
  give: (byte) => {
    given.push(byte);
  },
  take: () => {
    if (given.length) writeSync(1, Uint8Array.from(given));
    given = [];
    if (!taken.length) {
      const room = Buffer.alloc(4096);
      taken = room.subarray(0, readSync(0, room));
      if (!taken.length) process.exit(0);
    }
    const byte = taken[0];
    taken = taken.subarray(1);
    return byte;
  },
});
for (const name of readdirSync(folder)) {
  if (name.endsWith(".py") && name !== "__init__.py") {
    interpreter.FS.writeFile(`/${name}`, readFileSync(`${folder}/${name}`, "utf8"));
  }
}
try {
  interpreter.runPython(`import sys\nsys.path.append("/")\n`);
  interpreter.runPython(readFileSync(script, "utf8"));
} catch (error) {
  console.error(error.message);
  process.exit(1);
}
