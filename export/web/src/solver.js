// The page's side of the worker in which the graph runs.

import mjs from "onnxruntime-web/ort-wasm-simd-threaded.mjs?url";
import wasm from "onnxruntime-web/ort-wasm-simd-threaded.wasm?url";

import worker from "./wasm_worker.js?worker&url";

const MOST_THREADS = 4;
const absolute = (address) => new URL(address, document.baseURI).href;

export class Solver {
  #worker = startedWorker(absolute(worker));
  #waiting = [];
  #number = 0;
  #show = null;
  #loaded;
  facts = null;

  /** @param {(parts: number, bytes: number) => void} loaded called when parts of the engine, or bytes of its graph, are there. */
  constructor(loaded) {
    this.#loaded = loaded;
    this.#worker.onmessage = ({ data }) => this.#settle(data);
    this.#worker.onerror = (event) => this.#failAll(event.message || "the worker could not be started");
  }

  /** Ends the worker; what was asked of it fails. */
  close() {
    this.#worker.terminate();
    this.#failAll("it was closed");
  }

  /** Reads the graph; the answer says which engine runs it, and on how many threads. */
  async load(graph) {
    const cores = Math.max(1, navigator.hardwareConcurrency >> 1);
    const threads = self.crossOriginIsolated ? Math.min(MOST_THREADS, cores) : 1;
    const addresses = { graph: absolute(graph), mjs: absolute(mjs), wasm: absolute(wasm) };
    this.facts = (await this.#ask({ load: { ...addresses, threads } })).ready;
    return this.facts;
  }

  /** Gives a picture away, and returns what the graph says of it; one at a time, others after it. */
  async solve(picture, time, controls) {
    this.#number += 1;
    return (await this.#ask({ frame: { number: this.#number, time, picture, ...controls } }, [picture])).solved;
  }

  /**
   * Has the worker take pictures from a stream by itself, whatever this page is busy with.
   *
   * @param {ReadableStream} pictures of the camera; it is given away.
   * @param {(solved: object) => void} show takes each answer; the promise fails with the reason why there are no more.
   */
  async follow(pictures, show) {
    this.#show = show;
    await this.#ask({ follow: pictures }, [pictures]);
  }

  /** Says how pictures of that stream are solved from now on; null lets them go. */
  setControls(controls) {
    this.#worker.postMessage({ controls });
  }

  #ask(message, given = []) {
    return new Promise((resolve, reject) => {
      this.#waiting.push({ resolve, reject });
      this.#worker.postMessage(message, given);
    });
  }

  #settle(answer) {
    if ("loaded" in answer) return this.#loaded(answer.loaded, answer.bytes);
    if (answer.solved?.number === 0) return this.#show(answer.solved);
    const waiting = this.#waiting.shift(); // answers come in the order of what was asked
    if ("failed" in answer) waiting?.reject(new Error(answer.failed));
    else waiting?.resolve(answer);
  }

  /** Of a worker that has ended no answer comes, and nobody may wait for one. */
  #failAll(words) {
    for (const { reject } of this.#waiting.splice(0)) reject(new Error(words));
  }
}

/**
 * A worker under the page's own content security policy. One that is loaded from an address has the policy of that
 * answer's headers, which a static host does not send; one from a blob inherits the page's.
 */
function startedWorker(address) {
  const code = new Blob([`import ${JSON.stringify(address)};`], { type: "text/javascript" });
  const blob = URL.createObjectURL(code);
  return new Worker(blob, { type: "module" });
}
