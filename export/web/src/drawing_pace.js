// How often and how finely the character is drawn, by how long a drawing takes: without a graphics card it is drawn by the
// processor that solves.

const QUICK = 12; // milliseconds; a graphics card draws in less
const SHARE = 0.3; // of the time that slower drawing may take
const LONGEST_REST = 400; // milliseconds; the first drawing takes seconds
const PATIENCE = 5; // slow drawings in a row until they are made coarser
const COARSER = 0.7;
const COARSEST = 0.5; // pixels drawn for one of the page's
const POLL = 4; // milliseconds

export class DrawingPace {
  #slow = 0;

  /** @param {number} ratio pixels to be drawn for one of the page's, to begin with. */
  constructor(ratio) {
    this.ratio = Math.max(COARSEST, ratio);
  }

  /**
   * Learns of a drawing.
   *
   * @param {number} took milliseconds until it was finished.
   * @returns {number} milliseconds until the next may begin.
   */
  rest(took) {
    this.#slow = took > QUICK ? this.#slow + 1 : 0;
    if (this.#slow === PATIENCE) {
      this.ratio = Math.max(COARSEST, COARSER * this.ratio);
      this.#slow = 0;
    }
    return took > QUICK ? Math.min(LONGEST_REST, took * (1 / SHARE - 1)) : 0;
  }
}

/** Waits until all that a WebGL 2 context was told is drawn. */
export async function drawn(context) {
  const fence = context.fenceSync(context.SYNC_GPU_COMMANDS_COMPLETE, 0);
  context.flush();
  while (fence !== null && context.getSyncParameter(fence, context.SYNC_STATUS) === context.UNSIGNALED)
    await pause(POLL);
  context.deleteSync(fence);
}

export const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
