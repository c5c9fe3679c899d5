// Takes that the browser records and keeps.

import { forgetFile, keepFile, keptFile, keptFiles } from "./kept_files.js";
import { Take } from "./take.js";

const PREFIX = "take ";

export class BrowserTakes {
  #take = null;
  #changed;

  /** @param {() => void} changed called when the list is another one. */
  constructor(changed) {
    this.#changed = changed;
  }

  /** How long the take that runs is; null while none does. */
  get recording() {
    return this.#take && { seconds: this.#take.duration, frames: this.#take.frames.length };
  }

  start() {
    this.#take = new Take();
  }

  async stop() {
    const take = this.#take;
    this.#take = null;
    if (!take?.frames.length) return;
    const id = `${PREFIX}${String(Date.now()).padStart(15, "0")}`;
    const name = new Date().toLocaleString([], { dateStyle: "short", timeStyle: "medium" });
    await keepFile(id, { id, name, seconds: take.duration, frames: take.frames.length, rows: take.rows });
    this.#changed();
  }

  add(solved) {
    this.#take?.add(solved.time, solved);
    if (this.#take?.full) this.stop();
  }

  /** Newest first, each `{id, name, seconds, frames}`. */
  async list() {
    return (await keptFiles(PREFIX)).reverse();
  }

  async take(id) {
    return Take.ofRows((await keptFile(id)).rows);
  }

  async rename(id, name) {
    await keepFile(id, { ...(await keptFile(id)), name });
    this.#changed();
  }

  async remove(id) {
    await forgetFile(id);
    this.#changed();
  }
}
