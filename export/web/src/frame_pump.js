// The newest picture of the camera to the solver: while one is being solved those between are let go. Where the browser gives a
// stream of them, the solver's worker takes them itself, and no drawing of this page holds it up.

import { onFrame } from "./camera.js";

/**
 * Runs until `stop` is called.
 *
 * @param {HTMLVideoElement} video of the camera.
 * @param {Solver} solver with its graph loaded.
 * @param {() => object} controls what the sliders and the calibration say now; `reset` once for each time it is wanted.
 * @param {(solved: object) => void} show takes each answer.
 * @param {(error: Error) => void} fail gets the reason why there are no more frames.
 * @returns {{stop(): void}}
 */
export const pumpFrames = (...given) => ("MediaStreamTrackProcessor" in window ? followed : pumped)(...given);

function followed(video, solver, controls, show, fail) {
  const [track] = video.srcObject.getVideoTracks();
  let running = true, sent = "";

  const tell = () => {
    const now = running && !document.hidden ? controls() : null, words = JSON.stringify(now);
    if (words !== sent) solver.setControls(now);
    sent = now?.reset ? "" : words;
  };
  const stop = () => {
    running = false;
    tell();
    document.removeEventListener("visibilitychange", tell);
  };
  const seen = (solved) => {
    if (!running) return;
    show(solved);
    tell();
  };
  document.addEventListener("visibilitychange", tell);
  tell();
  solver.follow(new MediaStreamTrackProcessor({ track, maxBufferSize: 1 }).readable, seen).catch((error) => running && fail(error));
  return { stop };
}

function pumped(video, solver, controls, show, fail) {
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
