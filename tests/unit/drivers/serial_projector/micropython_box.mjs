// A trigger box in MicroPython's own interpreter: its serial port is stdin and stdout, its light and pulses are stderr.
//
// node micropython_box.mjs PACKAGE FIRMWARE BOOT CRC32,CRC32,… WIDTH HEIGHT
import { readFileSync, writeSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [, , packageFolder, firmware, boot, crc32, width, height] = process.argv;
const { loadMicroPython } = await import(pathToFileURL(`${packageFolder}/micropython.mjs`));
const interpreter = await loadMicroPython({ heapsize: 192 * 1024 });
for (const name of ["wire.py", "box.py", "protocol.py"]) {
  interpreter.FS.writeFile(`/${name}`, readFileSync(`${firmware}/${name}`, "utf8"));
}
const begun = process.hrtime.bigint();
interpreter.registerJsModule("world", {
  now_us: () => Number((process.hrtime.bigint() - begun) / 1000n),
  note: (text) => writeSync(2, `${text}\n`),
});
interpreter.runPython(`
import sys
sys.path.append("/")
import world
from binascii import hexlify, unhexlify
from box import Description, Hardware
from protocol import Device

class Light(Hardware):
    selected = None
    def time_us(self):
        return int(world.now_us())
    def select(self, pattern):
        self.selected = pattern
    def light(self):
        world.note("light %d" % self.selected)
    def dark(self):
        world.note("dark")
    def pulse(self):
        world.note("pulse")
    def dim(self, permille):
        return permille

about = Description("test-box", "1.0.0", ${width}, ${height}, [${crc32}], light_us=3000, error_us=1000, gap_us=2000,
                    hold_us=500, least_us=100)
world.note("ready " + sys.version)
device = Device(Light(), about, ${boot})

def feed(data):
    return hexlify(device.feed(unhexlify(data))).decode()

def poll():
    return hexlify(device.poll()).decode()
`);
const feed = interpreter.globals.get("feed");
const poll = interpreter.globals.get("poll");
const send = (hex) => hex && writeSync(1, Buffer.from(hex, "hex"));
process.stdin.on("data", (data) => send(feed(data.toString("hex"))));
process.stdin.on("end", () => process.exit(0));
setInterval(() => send(poll()), 1);
