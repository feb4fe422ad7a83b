// Bundles src/main.ts into dist/: the same bytes from the same sources, wherever it runs. With --check it writes
// nothing, and says whether dist/ is what the sources make.

import { build } from "esbuild";
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { gunzipSync, gzipSync } from "node:zlib";

const here = new URL(".", import.meta.url).pathname;
const out = `${here}dist`;

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

const licences = readFileSync(`${here}licences.txt`, "utf8").trim();
const script = Buffer.concat([
  Buffer.from(`/*!\n${licences}\n*/\n`),
  Buffer.from(await bundle("src/main.ts")),
]);
const style = Buffer.from(await bundle("src/viewer.css"));
const page = readFileSync(`${here}src/index.html`);

if (process.argv[2] === "--check") {
  // Compressors differ from one version of node to the next; what they compress does not.
  const present = [gunzipSync(readFileSync(`${out}/viewer.js.gz`)), readFileSync(`${out}/viewer.css`), readFileSync(`${out}/index.html`)];
  const stale = ["viewer.js.gz", "viewer.css", "index.html"].filter((_, index) => !present[index].equals([script, style, page][index]));
  if (stale.length > 0) {
    console.error(`dist/ is not what the sources make: ${stale.join(", ")}; run \`npm run build\` in client/viewer`);
    process.exit(1);
  }
  console.log("dist/ is what the sources make");
} else {
  mkdirSync(out, { recursive: true });
  // gzip's header has a time stamp, which zlib leaves at zero, and a byte for the system, which is set here.
  const zipped = gzipSync(script, { level: 9 });
  zipped[9] = 255;
  writeFileSync(`${out}/viewer.js.gz`, zipped);
  writeFileSync(`${out}/viewer.css`, style);
  writeFileSync(`${out}/index.html`, page);
  const kilobytes = (bytes) => `${(bytes.length / 1000).toFixed(0)} kB`;
  console.log(`viewer.js ${kilobytes(script)}, compressed ${kilobytes(zipped)}`);
}
