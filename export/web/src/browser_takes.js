// Takes that the browser records and keeps.

import { forgetFile, keepFile, keptFile, keptFiles } from "./kept_files.js";
import { liveLinkCsv } from "./live_link_csv.js";
import { Take } from "./take.js";
import { give } from "./take_files.js";
import { showProblem } from "./words.js";

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
    addEventListener("beforeunload", (event) => this.#take && event.preventDefault()); // the browser asks before a take is lost
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

  /** Keeps the take; one that this browser has no room for is given as a file, so that it is not lost. */
  async stop() {
    const take = this.#take, filmed = this.#film?.();
    this.#take = this.#film = null;
    if (!take?.frames.length) throw new Error("Nothing was recorded: no picture came before the take was ended.");
    const film = await filmed, name = new Date().toLocaleString([], { dateStyle: "short", timeStyle: "medium" });
    try {
      await this.keep(name, take, film);
    } catch (error) {
      give(name, ".csv", liveLinkCsv(take));
      throw new Error(`The take could not be kept (${error.name ?? error}); it was downloaded as a .csv${film ? ", without its film" : ""}. Delete other takes, then drop it on the page.`);
    }
  }

  /** Keeps a take, with the camera's film where there is one. */
  async keep(name, take, film = null) {
    const id = `${PREFIX}${String(Date.now()).padStart(15, "0")}`;
    await keepFile(id, { id, name, seconds: take.duration, frames: take.frames.length, rows: take.rows, film });
    this.#changed();
  }

  add(solved) {
    this.#take?.add(solved.time, solved);
    if (this.#take?.full) this.stop().catch(({ message }) => showProblem("takes", message));
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
