// The newest picture of the camera to the solver: while one is being solved those between are let go.

import { onFrame } from "./camera.js";

/**
 * Runs until `stop` is called.
 *
 * @param {HTMLVideoElement} video of the camera.
 * @param {Solver} solver with its graph loaded.
 * @param {() => object} controls what the sliders and the calibration say now.
 * @param {(solved: object) => void} show takes each answer.
 * @param {(error: Error) => void} fail gets the reason why there are no more frames.
 * @returns {{stop(): void}}
 */
export function pumpFrames(video, solver, controls, show, fail) {
  let running = true, working = false, newest = null;

  const seen = (time) => {
    if (!running) return;
    newest = time;
    onFrame(video, seen);
    if (!working) work();
  };

  async function work() {
    working = true;
    try {
      while (running && newest !== null && !document.hidden) {
        const time = newest;
        newest = null;
        if (video.readyState < HTMLMediaElement.HAVE_CURRENT_DATA) continue; // a camera that changes its size
        const picture = await createImageBitmap(video);
        const solved = await solver.solve(picture, time, controls());
        if (running) show(solved);
      }
    } catch (error) {
      if (running) fail(error);
    }
    working = false;
  }

  onFrame(video, seen);
  return { stop: () => (running = false) };
}
