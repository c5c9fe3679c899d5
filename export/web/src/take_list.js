// The list of takes: played, trimmed, renamed, deleted, and given as files.

import { readLiveLinkCsv } from "./live_link_csv.js";
import { keepSettings, settings } from "./settings.js";
import { give, KINDS } from "./take_files.js";
import { hideProblem, showProblem, speak } from "./words.js";

const FILM = "film";
const LARGEST = 128 * 2 ** 20; // bytes

const element = (id) => document.getElementById(id);

export class TakeList {
  #takes;
  #character;
  #show;
  #playing = null;
  #rows = new Map(); // by the take's id: what is said of it, and its row

  /**
   * @param {object} takes that are kept, such as `BrowserTakes`.
   * @param {() => object | null} character the one that is shown, for its .glb.
   * @param {(frame: object) => void} show takes each frame of a take that is played.
   */
  constructor(takes, character, show) {
    [this.#takes, this.#character, this.#show] = [takes, character, show];
    element("record").addEventListener("click", () => this.toggle());
    element("keep-film").checked = settings.keepFilm;
    element("keep-film").addEventListener("change", ({ target }) => keepSettings({ keepFilm: target.checked }));
  }

  get playing() {
    return this.#playing !== null;
  }

  toggle() {
    if (this.#takes.recording) this.stop();
    else {
      this.#playing?.stop();
      this.#tried(() => this.#takes.start(settings.keepFilm), "Recording");
    }
    this.tell();
  }

  stop() {
    if (!this.#takes.recording) return;
    this.#tried(() => this.#takes.stop(), "Recorded");
    this.tell();
  }

  /** Shows how long the take that runs is. */
  tell() {
    const { recording } = this.#takes, on = recording !== null;
    const button = element("record"), label = on ? "Stop recording" : "Record";
    if (button.textContent !== label) {
      button.textContent = label;
      button.setAttribute("aria-pressed", String(on));
    }
    element("recorded").textContent = on ? `${recording.seconds.toFixed(1)} s, ${recording.frames} frames` : "";
  }

  async refresh() {
    try {
      const found = await this.#takes.list(), before = this.#rows;
      // What has not changed stays as it is: somebody may be typing there, or trimming.
      this.#rows = new Map(found.map((one) => {
        const facts = JSON.stringify(one), known = before.get(one.id);
        return [one.id, known?.facts === facts ? known : { facts, row: this.#row(one) }];
      }));
      const playing = this.#playing, row = playing && this.#rows.get(playing.id);
      if (playing && (playing.still ? row !== before.get(playing.id) : !row)) playing.stop(); // it was deleted, or its sliders are gone
      const rows = [...this.#rows.values()].map(({ row }) => row), list = element("takes");
      for (const row of [...list.children]) if (!rows.includes(row)) row.remove();
      rows.forEach((row, i) => list.children[i] !== row && list.insertBefore(row, list.children[i] ?? null));
      this.#tellPlaying();
      element("no-takes").hidden = found.length > 0;
    } catch {
      element("no-takes").textContent = "This browser keeps no takes here.";
    }
  }

  #row({ id, name, seconds, frames, film = "", solvable = false }) {
    const row = document.createElement("li");
    const title = Object.assign(document.createElement("input"), { value: name, maxLength: 60, className: "name" });
    title.setAttribute("aria-label", "Name of the take");
    title.addEventListener("change", () => this.#tried(() => this.#takes.rename(id, title.value.trim() || name)));
    const facts = Object.assign(document.createElement("span"), { textContent: `${seconds.toFixed(1)} s, ${frames} frames` });
    const button = (label, kind, act) => {
      const made = Object.assign(document.createElement("button"), { type: "button", textContent: label, className: kind });
      made.setAttribute("aria-label", `${label} ${name}`);
      made.addEventListener("click", () => this.#tried(() => act(made)));
      return made;
    };
    const saving = Object.assign(document.createElement("select"), { className: "save" });
    saving.setAttribute("aria-label", `Save ${name} as`);
    saving.append(new Option("Save as…", ""), ...Object.keys(KINDS).map((kind) => new Option(kind, kind)));
    if (film) saving.append(new Option("the camera's film", FILM));
    saving.addEventListener("change", () => {
      const kind = saving.value;
      saving.value = "";
      if (kind) this.#tried(() => (kind === FILM ? this.#giveFilm(id, name, film) : this.#save(id, name, kind)));
    });
    row.append(
      title, facts,
      button("Play", "play", () => this.#play(id)),
      button("Trim", "trim", () => this.#trim(id, name, row)),
      saving,
      ...(solvable ? [button("Solve again", "solve", () => this.#takes.solve(id))] : []),
      button("Delete", "delete", () => this.#takes.remove(id)),
    );
    return row;
  }

  async #save(id, name, kind) {
    const working = element("working");
    try {
      working.value = `Making ${name}${kind} …`;
      const progress = (done) => (working.value = `Making ${name}${kind}: ${Math.round(100 * done)} %`);
      give(name, kind, await KINDS[kind](await this.#takes.take(id), this.#character(), progress));
    } finally {
      working.value = "";
    }
  }

  async #giveFilm(id, name, suffix) {
    give(`${name} camera`, suffix, await this.#takes.film(id));
  }

  /** Two times to be set, shown on the character as they are; what lies between becomes a take of its own. */
  async #trim(id, name, row) {
    const open = row.querySelector(".trimming");
    this.#playing?.stop();
    if (open) return open.remove();
    const take = await this.#takes.take(id), part = Object.assign(document.createElement("div"), { className: "trimming" });
    const [from, to] = [["from", 0], ["to", take.duration]].map(([word, value]) => {
      const input = Object.assign(document.createElement("input"), { type: "range", min: 0, max: take.duration, step: "any", value });
      const label = document.createElement("label"), time = document.createElement("output");
      const tell = () => (time.value = `${Number(input.value).toFixed(2)} s`);
      label.append(`${word} `, time, input);
      tell();
      input.addEventListener("input", () => {
        tell();
        this.#still(id, take.frames.findLast(({ seconds }) => seconds <= Number(input.value)) ?? take.frames[0]);
      });
      part.append(label);
      return input;
    });
    const keep = Object.assign(document.createElement("button"), { type: "button", textContent: "Keep this part" });
    keep.addEventListener("click", () => this.#tried(async () => {
      const kept = take.part(Number(from.value), Number(to.value) + 1e-6); // a slider keeps fewer digits than a frame's time
      if (kept.frames.length === 0) throw new Error("No frame lies between these two times.");
      this.#playing?.stop();
      await this.#takes.keep(`${name}, part`, kept);
      part.remove();
    }, "Kept"));
    part.append(keep);
    row.append(part);
  }

  /** Shows one frame until something else is shown. */
  #still(id, frame) {
    this.#playing ??= { id, still: true, stop: () => (this.#playing = null) };
    this.#show(frame);
  }

  /** Takes a recording that was dropped on the page. */
  async take(file) {
    await this.#tried(async () => {
      if (file.size > LARGEST) throw new Error(`${file.name}: the page takes recordings of up to ${LARGEST / 2 ** 20} MB.`);
      let take;
      try {
        take = readLiveLinkCsv(await file.text());
      } catch (error) {
        throw new Error(`${file.name}: ${error.message}`);
      }
      await this.#takes.keep(file.name.replace(/\.csv$/i, ""), take);
    }, "Taken");
  }

  /** Says at each take whether it plays; its row may be another than when it began. */
  #tellPlaying() {
    for (const [id, { row }] of this.#rows) {
      const words = this.#playing?.id === id && !this.#playing.still ? "Stop" : "Play", button = row.querySelector(".play");
      if (button.textContent !== words) button.textContent = words;
    }
  }

  async #play(id) {
    const stopped = this.#playing;
    stopped?.stop();
    if (stopped?.id === id && !stopped.still) return;
    const { frames } = await this.#takes.take(id), began = performance.now();
    if (this.#playing) this.#playing.stop(); // begun meanwhile
    const playing = { id, still: false, stop: () => ((this.#playing = null), this.#tellPlaying()) };
    this.#playing = playing;
    this.#tellPlaying();
    let at = 0;
    const next = (now) => {
      if (this.#playing !== playing) return;
      while (at + 1 < frames.length && frames[at + 1].seconds <= (now - began) / 1000) at += 1;
      this.#show(frames[at]);
      if (at + 1 < frames.length) requestAnimationFrame(next);
      else playing.stop();
    };
    requestAnimationFrame(next);
  }

  async #tried(act, words = "") {
    try {
      await act();
      hideProblem("takes");
      if (words) speak(words);
    } catch (error) {
      showProblem("takes", error.message);
    }
  }
}
