// three.js's own decoders of Draco and Basis Universal, as files of the page.

import { LoadingManager } from "three";
import { DRACOLoader } from "three/addons/loaders/DRACOLoader.js";
import { KTX2Loader } from "three/addons/loaders/KTX2Loader.js";
import basisBinary from "three/addons/libs/basis/basis_transcoder.wasm?url";
import draco from "three/addons/libs/draco/gltf/draco_wasm_wrapper.js?url";
import dracoBinary from "three/addons/libs/draco/gltf/draco_decoder.wasm?url";

const WORKER = "./assets/basis_worker.js"; // see vite.config.js
const FILES = { "draco_wasm_wrapper.js": draco, "draco_decoder.wasm": dracoBinary };
const manager = new LoadingManager();
manager.setURLModifier((name) => (name in FILES ? new URL(FILES[name], document.baseURI).href : name));

let kept = null;

export const dracoLoader = () => new DRACOLoader(manager);

/** One for all characters, as three.js asks for. */
export async function ktx2Loader() {
  if (kept === null) {
    const context = new OffscreenCanvas(1, 1).getContext("webgl2");
    const extensions = { has: (name) => Boolean(context?.getExtension(name)), get: (name) => context.getExtension(name) };
    kept = new KTX2Loader(manager).detectSupport({ extensions });
    context?.getExtension("WEBGL_lose_context")?.loseContext();
    const transcoder = await (await fetch(new URL(basisBinary, document.baseURI))).arrayBuffer();
    kept.transcoderPending = Promise.resolve(); // what follows is in place of its own preparation
    kept.workerPool.setWorkerCreator(() => {
      const worker = new Worker(new URL(WORKER, document.baseURI)), transcoderBinary = transcoder.slice(0);
      worker.postMessage({ type: "init", config: kept.workerConfig, transcoderBinary }, [transcoderBinary]);
      return worker;
    });
  }
  return kept;
}
