// How many frames a second were solved lately, and how long one took.

const SPAN = 2000; // milliseconds

export class FrameRate {
  #seen = [];

  /** Counts a frame: what the graph and the picture's way to it took, and the camera's time, as answers may come all at once. */
  add({ milliseconds, time }) {
    const now = performance.now();
    this.#seen.push({ now, milliseconds, time });
    this.#seen = this.#seen.filter((one) => now - one.now < SPAN);
  }

  /** `{perSecond, milliseconds}`; none while too few are known. */
  get() {
    const seen = this.#seen.filter((one) => performance.now() - one.now < SPAN);
    if (seen.length < 4) return null;
    const perSecond = (1000 * (seen.length - 1)) / (seen.at(-1).time - seen[0].time);
    if (!(perSecond > 0)) return null; // a film that has begun anew
    return { perSecond, milliseconds: seen.map((one) => one.milliseconds).sort((a, b) => a - b)[seen.length >> 1] };
  }

  forget() {
    this.#seen = [];
  }
}
