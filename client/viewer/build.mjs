// Bundles src/main.ts into dist/: the same bytes from the same sources, wherever it runs.

import { build } from "esbuild";
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";

const here = new URL(".", import.meta.url).pathname;
const out = process.argv[2] ?? `${here}dist`;

async function bundle(entry, loader) {
  const result = await build({
    entryPoints: [`${here}${entry}`],
    absWorkingDir: here,
    bundle: true,
    write: false,
    minify: true,
    format: "esm",
    target: "es2022",
    charset: "utf8",
    legalComments: "none",
    define: { "process.env.NODE_ENV": '"production"' },
    ...(loader ? { loader } : {}),
  });
  return result.outputFiles[0].contents;
}

mkdirSync(out, { recursive: true });
const licences = readFileSync(`${here}licences.txt`, "utf8").trim();
const script = Buffer.concat([
  Buffer.from(`/*!\n${licences}\n*/\n`),
  Buffer.from(await bundle("src/main.ts")),
]);
// gzip's header has a time stamp, which zlib leaves at zero, and a byte for the system, which is set here.
const zipped = gzipSync(script, { level: 9 });
zipped[9] = 255;
writeFileSync(`${out}/viewer.js.gz`, zipped);
writeFileSync(`${out}/viewer.css`, await bundle("src/viewer.css"));
writeFileSync(`${out}/index.html`, readFileSync(`${here}src/index.html`));
const kilobytes = (bytes) => `${(bytes.length / 1000).toFixed(0)} kB`;
console.log(`viewer.js ${kilobytes(script)}, compressed ${kilobytes(zipped)}`);
