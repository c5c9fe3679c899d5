// A recording: weights and rotations of each frame, at the camera's own times.

export const LONGEST = 3600; // seconds; about 40 MB
const ROW = 66;

export class Take {
  frames = [];
  #start = null;

  /**
   * Adds a frame.
   *
   * @param {number} time of the camera's picture, milliseconds of the page's clock; a time that does not rise is dropped.
   * @param {{weights: Float32Array, rotation: Float32Array, gaze: Float32Array}} solved what the graph says.
   */
  add(time, { weights, rotation, gaze }) {
    this.#start ??= time;
    const seconds = Math.fround((time - this.#start) / 1000); // as it stands in a .glb, where times must rise
    if (this.frames.length > 0 && seconds <= this.frames.at(-1).seconds) return;
    this.frames.push({ seconds, weights: weights.slice(), rotation: rotation.slice(), gaze: gaze.slice() });
  }

  /** Rows of `ROW` numbers: seconds, weights, rotation, gaze. */
  static ofRows(rows) {
    const take = new Take();
    for (let at = 0; at + ROW <= rows.length; at += ROW) {
      const part = (first, count) => rows.slice(at + first, at + first + count);
      take.frames.push({ seconds: rows[at], weights: part(1, 52), rotation: part(53, 9), gaze: part(62, 4) });
    }
    return take;
  }

  /** The part from one time to another, seconds, beginning at 0. */
  part(from, to) {
    const part = new Take();
    for (const frame of this.frames) if (frame.seconds >= from && frame.seconds <= to) part.add(1000 * frame.seconds, frame);
    return part;
  }

  get rows() {
    const rows = new Float32Array(ROW * this.frames.length);
    this.frames.forEach(({ seconds, weights, rotation, gaze }, i) => rows.set([seconds, ...weights, ...rotation, ...gaze], ROW * i));
    return rows;
  }

  get seconds() {
    return this.frames.map((frame) => frame.seconds);
  }

  get duration() {
    return this.frames.at(-1)?.seconds ?? 0;
  }

  get full() {
    return this.duration >= LONGEST;
  }

  /** Frames a second in the mean, as all files of the take say; 30 of a single frame. */
  get rate() {
    return this.duration > 0 ? (this.frames.length - 1) / this.duration : 30;
  }
}
