// The guided calibration: a face at rest, then five poses, each of which counts only where it is seen in the weights.
// It knows weights and nothing of what solves them.

import { ARKIT } from "./arkit_names.js";

const row = (name) => ARKIT.indexOf(name);
const REST = { pose: 1, words: "Look into the camera with a resting face.", short: "resting face", shapes: [] };
/** What the solvers call each pose (0: none of theirs), what the person is asked for, and in which shapes it is seen. */
const POSES = [
  { pose: 2, words: "Open your mouth wide.", short: "open mouth", shapes: [["jawOpen"]] },
  { pose: 3, words: "Smile broadly.", short: "smile", shapes: [["mouthSmileLeft", "mouthSmileRight"]] },
  { pose: 4, words: "Raise your eyebrows.", short: "raised eyebrows", shapes: [["browInnerUp"], ["browOuterUpLeft", "browOuterUpRight"]] },
  { pose: 5, words: "Shut your eyes until you hear the tone.", short: "shut eyes", shapes: [["eyeBlinkLeft", "eyeBlinkRight"]] },
  { pose: 0, words: "Pucker your lips.", short: "puckered lips", shapes: [["mouthPucker"], ["mouthFunnel"]], learned: ["mouthPucker", "mouthFunnel"] },
];
const COUNTDOWN = 3; // seconds at rest
const STILL = 0.12; // of a weight from its mean of late; more is a face that moves
const MEMORY = 0.3; // seconds of that mean
const LONGEST_REST = 20; // seconds until a restless face is given up: poses are then seen over its mean
const LEAST = 0.2; // of a weight over rest: a pose that is held
const NEARLY = 0.08; // and one that has begun
const HOLD = 1; // seconds
const PATIENCE = 6; // seconds until a pose is asked for again
const ASKED = 2; // times
const LONGEST_STEP = 0.25; // seconds that one frame may count for
const WANTED = 0.8, MOST_GAIN = 2; // of a shape that is fully shown, and by how much a weak one is raised

export class Calibration {
  #step = -1; // the resting face
  #held = 0;
  #waited = 0;
  #asked = 1;
  #before = null;
  #mean = null;
  #rest = null;
  #most = 0;
  #missed = [];
  #gains = {};
  #remark = "";

  get #task() {
    return this.#step < 0 ? REST : POSES[this.#step];
  }

  get prompt() {
    return this.#task.words;
  }

  /** The remark on what is seen now. */
  get remark() {
    return this.#remark;
  }

  get number() {
    return this.#step + 2;
  }

  static get count() {
    return POSES.length + 1;
  }

  /** How far it is, of 1. */
  get progress() {
    return (this.number - 1 + Math.min(1, this.#held / (this.#step < 0 ? COUNTDOWN : HOLD))) / Calibration.count;
  }

  /** The pose that is seen now, which the solver may learn from; 0 otherwise. */
  get pose() {
    return this.#held > 0 ? this.#task.pose : 0;
  }

  /** What was asked for and not seen, in words. */
  get missed() {
    return this.#missed;
  }

  /** What came of it, in words. */
  get result() {
    const missed = this.#missed.join(", ");
    if (POSES.every(({ short }) => this.#missed.includes(short))) return `Not calibrated: no pose was seen (${missed}). Calibrate again, and hold each pose until the tone.`;
    return missed ? `Calibrated, but these poses were not seen: ${missed}.` : "Calibrated.";
  }

  /** Factors by which shapes of this person are raised, by name. */
  get gains() {
    return this.#gains;
  }

  /**
   * Goes on by a frame.
   *
   * @param {number} time of the picture, milliseconds.
   * @param {boolean} seen whether there is a face in it.
   * @param {ArrayLike<number>} weights by ARKit's names.
   * @returns {"same" | "next" | "again" | "done"} what is asked for now.
   */
  advance(time, seen, weights) {
    const passed = this.#before === null ? 0 : Math.min(LONGEST_STEP, Math.max(0, time - this.#before) / 1000);
    this.#before = time;
    if (!seen) {
      this.#remark = "Your face is not seen: the clock stands.";
      return "same";
    }
    this.#waited += passed;
    return this.#step < 0 ? this.#settle(passed, weights) : this.#hold(passed, weights);
  }

  #settle(passed, weights) {
    this.#mean ??= Float64Array.from(weights);
    const share = Math.exp(-passed / MEMORY);
    let moved = 0;
    for (let i = 0; i < weights.length; i++) {
      moved = Math.max(moved, Math.abs(weights[i] - this.#mean[i]));
      this.#mean[i] = weights[i] + share * (this.#mean[i] - weights[i]);
    }
    const restless = moved > STILL, given = restless && this.#waited >= LONGEST_REST;
    this.#held = restless ? 0 : this.#held + passed;
    this.#remark = restless ? "Your face moves: let it rest." : `${Math.max(1, Math.ceil(COUNTDOWN - this.#held))} …`;
    if (given) this.#missed.push(this.#task.short);
    else if (this.#held < COUNTDOWN) return "same";
    this.#rest = this.#mean;
    return this.#next();
  }

  #hold(passed, weights) {
    const { shapes, learned } = this.#task;
    const shown = shapes.map((names) => names.reduce((sum, name) => sum + weights[row(name)] - this.#rest[row(name)], 0) / names.length);
    const rise = Math.max(...shown);
    if (rise >= LEAST) {
      this.#held += passed;
      for (const name of learned ?? []) this.#most = Math.max(this.#most, weights[row(name)]);
      this.#remark = "Good: hold it.";
      if (this.#held < HOLD) return "same";
      for (const name of learned ?? []) this.#gains[name] = Math.min(MOST_GAIN, Math.max(1, WANTED / this.#most));
      return this.#next();
    }
    this.#held = 0;
    if (this.#waited >= PATIENCE) {
      if (this.#asked === ASKED) {
        this.#missed.push(this.#task.short);
        return this.#next();
      }
      this.#asked += 1;
      this.#waited = 0;
      return "again";
    }
    if (rise > NEARLY) this.#remark = "A little more.";
    else this.#remark = this.#asked > 1 ? "It was not seen: once more." : "";
    return "same";
  }

  #next() {
    this.#held = this.#waited = this.#most = 0;
    this.#asked = 1;
    this.#remark = "";
    if (this.#step === POSES.length - 1) return "done";
    this.#step += 1;
    return "next";
  }
}

/** A short soft tone: whoever has their eyes shut cannot read that it is over. */
export function tone() {
  const context = new AudioContext();
  const [source, volume] = [context.createOscillator(), context.createGain()];
  source.frequency.value = 660;
  volume.gain.setValueAtTime(0.12, context.currentTime);
  volume.gain.exponentialRampToValueAtTime(0.001, context.currentTime + 0.35);
  source.connect(volume).connect(context.destination);
  source.onended = () => context.close();
  source.start();
  source.stop(context.currentTime + 0.4);
}
