// Takes that the browser records and keeps.

import { forgetFile, keepFile, keptFile, keptFiles } from "./kept_files.js";
import { Take } from "./take.js";

const PREFIX = "take ";
const FILMS = { "video/mp4": ".mp4", "video/webm": ".webm" }; // by what the browser records

export class BrowserTakes {
  #take = null;
  #film = null;
  #changed;
  stream = null; // of the camera, while it runs

  /** @param {() => void} changed called when the list is another one. */
  constructor(changed) {
    this.#changed = changed;
  }

  /** How long the take that runs is; null while none does. */
  get recording() {
    return this.#take && { seconds: this.#take.duration, frames: this.#take.frames.length };
  }

  /** @param {boolean} filmed whether the camera's film is kept too. */
  start(filmed = false) {
    this.#take = new Take();
    this.#film = filmed && this.stream !== null ? recorded(this.stream) : null;
  }

  async stop() {
    const take = this.#take, film = this.#film?.();
    this.#take = this.#film = null;
    if (take?.frames.length) await this.keep(new Date().toLocaleString([], { dateStyle: "short", timeStyle: "medium" }), take, await film);
  }

  /** Keeps a take, with the camera's film where there is one. */
  async keep(name, take, film = null) {
    const id = `${PREFIX}${String(Date.now()).padStart(15, "0")}`;
    await keepFile(id, { id, name, seconds: take.duration, frames: take.frames.length, rows: take.rows, film });
    this.#changed();
  }

  add(solved) {
    this.#take?.add(solved.time, solved);
    if (this.#take?.full) this.stop();
  }

  /** Newest first, each `{id, name, seconds, frames, film}`, the last a suffix. */
  async list() {
    return (await keptFiles(PREFIX)).reverse().map((one) => ({ ...one, film: one.film ? FILMS[one.film.type.split(";")[0]] : "" }));
  }

  async film(id) {
    return (await keptFile(id)).film;
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

/** Records a stream; what is returned ends that and gives the film. */
function recorded(stream) {
  const type = Object.keys(FILMS).find((one) => MediaRecorder.isTypeSupported(one)), parts = [];
  const recorder = new MediaRecorder(stream, { mimeType: type, videoBitsPerSecond: 8_000_000 });
  const film = new Promise((resolve) => (recorder.onstop = () => resolve(new Blob(parts, { type }))));
  recorder.ondataavailable = ({ data }) => parts.push(data);
  recorder.start(1000); // milliseconds of a part
  return () => {
    if (recorder.state !== "inactive") recorder.stop();
    return film;
  };
}
