// Ten guided seconds: five things to do with one's face, two seconds each, counted only while the face is seen.

/** What the graph calls each pose, and what the person is asked for. */
const STEPS = [
  { pose: 1, words: "Look into the camera with a resting face." },
  { pose: 2, words: "Open your mouth wide." },
  { pose: 3, words: "Smile broadly." },
  { pose: 4, words: "Raise your eyebrows." },
  { pose: 5, words: "Shut your eyes until you hear the tone." },
];
const SETTLE = 0.7; // seconds until somebody does what is asked; the graph gets the pose only then
const HOLD = 1.3; // seconds
const LONGEST_STEP = 0.25; // seconds that one frame may count for

export class Calibration {
  #step = 0;
  #seconds = 0;
  #before = null;

  get prompt() {
    return STEPS[this.#step].words;
  }

  get number() {
    return this.#step + 1;
  }

  static get count() {
    return STEPS.length;
  }

  /** How far it is, of 1. */
  get progress() {
    return (this.#step + Math.min(1, this.#seconds / (SETTLE + HOLD))) / STEPS.length;
  }

  /** The pose that the person holds by now; 0 while they get there. */
  get pose() {
    return this.#seconds >= SETTLE ? STEPS[this.#step].pose : 0;
  }

  /**
   * Goes on by a frame.
   *
   * @param {number} time of the picture, milliseconds.
   * @param {boolean} seen whether there is a face in it.
   * @returns {"same" | "next" | "done"} what is asked for now.
   */
  advance(time, seen) {
    const passed = this.#before === null ? 0 : Math.min(LONGEST_STEP, (time - this.#before) / 1000);
    this.#before = time;
    if (!seen) return "same";
    this.#seconds += passed;
    if (this.#seconds < SETTLE + HOLD) return "same";
    if (this.#step === STEPS.length - 1) return "done";
    this.#step += 1;
    this.#seconds = 0;
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
