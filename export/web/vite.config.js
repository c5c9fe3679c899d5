// One folder of files with relative addresses, for any static host; LICENCES.txt says what is inside and whose it is.

import { existsSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

import { KTX2Loader } from "three/addons/loaders/KTX2Loader.js";

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
      read("./licences/decoders.txt"),
      `ONNX Runtime Web ${version("onnxruntime-web")}, https://onnxruntime.ai\n\n${read("./licences/onnxruntime.txt")}`,
    ];
    this.emitFile({ type: "asset", fileName: "LICENCES.txt", source: parts.join(`\n${"-".repeat(80)}\n\n`) });
  },
};

/**
 * The worker of KTX2 pictures as a file of its own. three.js makes it of strings in a blob, which is under the page's policy,
 * and the transcoder makes functions of strings when it starts.
 */
const basisWorker = {
  name: "basis-worker",
  generateBundle() {
    const constants = ["EngineFormat", "EngineType", "TranscoderFormat", "BasisFormat"].map((name) => `let _${name} = ${JSON.stringify(KTX2Loader[name])};`);
    const code = String(KTX2Loader.BasisWorker), body = code.slice(code.indexOf("{") + 1, code.lastIndexOf("}"));
    const source = [...constants, packaged("three", "examples/jsm/libs/basis/basis_transcoder.js"), body].join("\n");
    this.emitFile({ type: "asset", fileName: "assets/basis_worker.js", source });
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
  plugins: [licences, basisWorker],
};
