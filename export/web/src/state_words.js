// The state of the face that is followed, in words.

const SEEN = 0.5; // of presence; below it there is no face
const GONE = 1000; // milliseconds without a face until that is said
const LEARNED = 0.99;
const PERSON = 0.65; // of the smoothed count, in which somebody is 1 and the face on a shirt is up to 0.61 now and then
const NUMBERS = ["No", "One", "Two", "Three", "Four", "Many"];

export const isSeen = (solved) => solved.presence > SEEN;

const whichOne = (left, right) => (left === 0 ? "left" : right === 0 ? "right" : "middle");

export class StateWords {
  #lastSeen = -Infinity;
  #ever = false;

  /** Begins anew, as after a pause. */
  forget() {
    this.#lastSeen = performance.now();
  }

  /** What a frame shows. */
  of(solved, mirrored = true) {
    const now = performance.now();
    if (isSeen(solved)) {
      this.#lastSeen = now;
      this.#ever = true;
    } else if (now - this.#lastSeen > GONE) {
      return this.#ever ? "Your face is hidden: the last expression is held, then relaxes." : "No face is seen. Move into the picture, with light on your face.";
    }
    const [left, right] = [...solved.beside].map((count) => Math.floor(count + 1 - PERSON));
    if (isSeen(solved) && left + right > 0) return `${NUMBERS[Math.min(1 + left + right, 5)]} people: following the ${whichOne(mirrored ? right : left, mirrored ? left : right)} one.`;
    if (solved.calibrated < LEARNED) return `Learning your face: ${Math.floor(100 * solved.calibrated)} %.`;
    return "Your face is followed.";
  }
}
