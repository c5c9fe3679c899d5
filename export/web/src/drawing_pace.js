// How often and how finely the character is drawn, by how long a drawing takes: without a graphics card it is drawn by the
// processor that solves.

const QUICK = 12; // milliseconds; a graphics card draws in less
const SHARE = 0.5; // of the time that slower drawing may take
const LONGEST_REST = 400; // milliseconds; the first drawing takes seconds
const SLOW_ONES = 5; // drawings in a row until they are made coarser
const COARSER = 0.7; // about half the pixels
const WORTH = 0.8; // of the time before: coarser drawing that takes more was in vain
const COARSEST = 0.5; // pixels drawn for one of the page's
const POLL = 4; // milliseconds

export class DrawingPace {
  #slow = [];
  #before = null;
  #settled = false;
  #coarsest;

  /**
   * @param {number} ratio pixels to be drawn for one of the page's, to begin with.
   * @param {number} coarsest the least of them.
   */
  constructor(ratio, coarsest = COARSEST) {
    [this.ratio, this.#coarsest] = [ratio, coarsest];
  }

  /**
   * Learns of a drawing.
   *
   * @param {number} took milliseconds until it was finished.
   * @returns {number} milliseconds until the next may begin.
   */
  rest(took) {
    if (took <= QUICK) {
      this.#slow = [];
      return 0;
    }
    this.#slow.push(took);
    if (this.#slow.length === SLOW_ONES) this.#adapt();
    return Math.min(LONGEST_REST, took * (1 / SHARE - 1));
  }

  #adapt() {
    const took = this.#slow.sort((a, b) => a - b)[SLOW_ONES >> 1];
    this.#slow = [];
    if (this.#settled) return;
    if (this.#before !== null && took > WORTH * this.#before.took) {
      this.#settled = true; // it is not the pixels
      this.ratio = this.#before.ratio;
    } else if (this.ratio > this.#coarsest) {
      this.#before = { ratio: this.ratio, took };
      this.ratio = Math.max(this.#coarsest, COARSER * this.ratio);
    }
  }
}

/** Waits until a WebGL 2 context has drawn all its commands. */
export async function drawn(context) {
  const fence = context.fenceSync(context.SYNC_GPU_COMMANDS_COMPLETE, 0);
  context.flush();
  while (fence !== null && context.getSyncParameter(fence, context.SYNC_STATUS) === context.UNSIGNALED)
    await pause(POLL);
  context.deleteSync(fence);
}

export const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
