// What the user set is applied to solved weights: gain, dead zone and smoothing of each shape, a new centre of head and
// gaze, and a face that is held. torchface's `workflows/live/weight_controls.py` computes the same where Python solves.

import { ARKIT } from "./arkit_names.js";

const SLOWEST = 0.25; // seconds: the time constant of all smoothing

/** Groups of shapes, in the order in which the page has them. */
export const GROUPS = {
  brows: /^brow/,
  lids: /^eye(Blink|Squint|Wide)/,
  gaze: /^eyeLook/,
  jaw: /^jaw/,
  mouth: /^(mouth|tongue)/,
  "cheeks and nose": /^(cheek|nose)/,
};

export const USUAL = Object.freeze({ gain: 1, dead: 0, smoothing: 0, muted: false });

/** Settings by group, and factors by shape, as three numbers for each of ARKit's shapes. */
export function shapeSettings(groups, gains = {}) {
  const of = (name) => ({ ...USUAL, ...groups[Object.keys(GROUPS).find((group) => GROUPS[group].test(name))] });
  const all = ARKIT.map((name) => ({ name, ...of(name) }));
  return {
    gain: all.map((one) => (one.muted ? 0 : one.gain * (gains[one.name] ?? 1))),
    dead: all.map((one) => one.dead),
    smoothing: all.map((one) => one.smoothing),
  };
}

export class WeightControls {
  #before = null;

  /**
   * A solved frame as the user wants it; the frame given stays as it is.
   *
   * @param {object} solved with weights, rotation, gaze and the interval in seconds.
   * @param {object} settings gain, dead, smoothing (52 each), centre ({rotation, gaze} or null), frozen.
   */
  apply(solved, { gain, dead, smoothing, centre, frozen }) {
    if (frozen && this.#before !== null) return { ...solved, ...this.#before };
    const weights = Float32Array.from(solved.weights, (value, i) => {
      const scaled = Math.min(1, Math.max(0, (gain[i] * Math.max(0, value - dead[i])) / (1 - dead[i])));
      if (this.#before === null || smoothing[i] === 0) return scaled;
      return scaled + Math.exp(-solved.interval / (SLOWEST * smoothing[i])) * (this.#before.weights[i] - scaled);
    });
    const rotation = centre ? fromCentre(solved.rotation, centre.rotation) : solved.rotation;
    const gaze = centre ? Float32Array.from(solved.gaze, (angle, i) => angle - centre.gaze[i]) : solved.gaze;
    this.#before = { weights, rotation, gaze };
    return { ...solved, ...this.#before };
  }
}

/** R Cᵀ diag(1, -1, -1): of a head that is turned as the centre the rotation of one that looks into the lens. */
function fromCentre(r, c) {
  return Float32Array.from({ length: 9 }, (_, at) => {
    const [i, j] = [Math.floor(at / 3), at % 3];
    return (j === 0 ? 1 : -1) * [0, 1, 2].reduce((sum, k) => sum + r[3 * i + k] * c[3 * j + k], 0);
  });
}
