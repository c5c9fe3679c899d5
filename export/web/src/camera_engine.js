// The engine in the browser: its camera, and the graph in a worker.

import { BrowserTakes } from "./browser_takes.js";
import { closeCamera, openCamera } from "./camera.js";
import { PARTS } from "./frame_answers.js";
import { pumpFrames } from "./frame_pump.js";
import { Solver } from "./solver.js";
import { WeightControls } from "./weight_controls.js";

export class CameraEngine {
  #page;
  #video;
  #controls = new WeightControls();
  #solver = null;
  #loading = null;
  #stream = null;
  #pump = null;
  #reset = false;
  #loadingWords = "";

  /**
   * @param {object} page `{controls(), show(solved), running(on), status(words), loading(words), problem(words), takesChanged()}`.
   * @param {HTMLVideoElement} video where the camera is shown.
   */
  constructor(page, video) {
    [this.#page, this.#video] = [page, video];
    this.takes = new BrowserTakes(page.takesChanged);
  }

  get running() {
    return this.#stream !== null;
  }

  get threads() {
    return this.#solver?.facts?.threads ?? 1;
  }

  reset() {
    this.#reset = true;
  }

  /** Loads the solver, so that the first picture finds it ready. */
  prepare() {
    this.#loaded().catch(() => {}); // said by the start, which tries again
  }

  async start() {
    try {
      this.#page.status("Asking for the camera…");
      const loaded = this.#loaded(); // while the user is asked
      loaded.catch(() => {}); // said once the camera is there
      this.takes.stream = this.#stream = await openCamera(this.#video, () => this.stop("The camera was unplugged, or may no longer be used."));
      this.#page.running(true);
      this.#tell();
      await loaded;
      if (this.#stream !== null) this.#run(); // else it was taken away meanwhile
    } catch (error) {
      this.stop(error.message);
    }
  }

  stop(problem = "") {
    this.#pump?.stop();
    const stream = this.#stream;
    this.#pump = this.#stream = null;
    this.#page.running(false);
    this.takes.stream = null;
    if (stream !== null) closeCamera(this.#video, stream); // after the recording, whose film ends with it
    if (problem) this.#page.problem(problem);
  }

  #run() {
    const controls = () => {
      const reset = this.#reset;
      this.#reset = false;
      return { ...this.#page.controls().solver, reset };
    };
    const show = (solved) => {
      const wanted = this.#controls.apply(solved, this.#page.controls().weights);
      this.takes.add(wanted);
      this.#page.show(wanted, solved);
    };
    this.#pump = pumpFrames(this.#video, this.#solver, controls, show, (error) => {
      this.#forget();
      this.stop(`The solver stopped: ${error.message}`);
    });
  }

  #tell(parts = 0, bytes = 0) {
    if (parts || bytes || !this.#loadingWords) this.#loadingWords = `Loading the face reader: ${(bytes / 1e6).toFixed(1)} MB are here, ${parts} of ${PARTS} steps are done…`;
    if (this.running) this.#page.status(this.#loadingWords);
    else this.#page.loading(this.#loadingWords);
  }

  /** The solver, which is loaded once; after a failure once more. */
  async #loaded() {
    this.#loading ??= (this.#solver = new Solver((...here) => this.#tell(...here))).load("./webcam.graph");
    try {
      await this.#loading;
      this.#page.loading("");
    } catch (error) {
      this.#forget();
      this.#page.loading("");
      throw new Error(`The solver could not be loaded: ${error.message}.`);
    }
  }

  #forget() {
    this.#solver?.close();
    this.#solver = this.#loading = null;
    this.#loadingWords = "";
  }
}
