// One folder of files with relative addresses, for any static host; LICENCES.txt says what is inside and whose it is.

import { existsSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const read = (path) => readFileSync(new URL(path, import.meta.url), "utf8");

/** A file of an installed package, beside this folder or above it. */
function packaged(name, file) {
  const places = createRequire(import.meta.url).resolve.paths(name).map((place) => join(place, name, file));
  return readFileSync(places.find(existsSync), "utf8");
}

const licences = {
  name: "licences",
  generateBundle() {
    const version = (name) => JSON.parse(packaged(name, "package.json")).version;
    const parts = [
      read("./licences/torchface.txt"),
      `three.js ${version("three")}, https://threejs.org\n\n${packaged("three", "LICENSE")}`,
      `ONNX Runtime Web ${version("onnxruntime-web")}, https://onnxruntime.ai\n\n${read("./licences/onnxruntime.txt")}`,
    ];
    this.emitFile({ type: "asset", fileName: "LICENCES.txt", source: parts.join(`\n${"-".repeat(80)}\n\n`) });
  },
};

/** Some hosts do not know .mjs for JavaScript. */
const assetName = ({ names }) => (names[0].endsWith(".mjs") ? "assets/[name]-[hash].js" : "assets/[name]-[hash][extname]");

export default {
  base: "./",
  // onnxruntime-web's build without its own WebAssembly inside, which is a file of its own here.
  resolve: { conditions: ["onnxruntime-web-use-extern-wasm", "module", "browser"] },
  build: {
    target: "es2022",
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 1000,
    rollupOptions: { output: { assetFileNames: assetName } },
  },
  worker: { format: "es", rollupOptions: { output: { assetFileNames: assetName } } },
  plugins: [licences],
};
