// The list of takes: played, renamed, deleted, and given as files.

import { animatedGlb } from "./glb_animation.js";
import { liveLinkCsv } from "./live_link_csv.js";
import { showProblem, speak } from "./words.js";

const element = (id) => document.getElementById(id);

export class TakeList {
  #takes;
  #character;
  #show;
  #playing = null;

  /**
   * @param {object} takes that are kept, such as `BrowserTakes`.
   * @param {() => object | null} character the one that is shown, for its .glb.
   * @param {(frame: object) => void} show takes each frame of a take that is played.
   */
  constructor(takes, character, show) {
    [this.#takes, this.#character, this.#show] = [takes, character, show];
    element("record").addEventListener("click", () => this.toggle());
  }

  get playing() {
    return this.#playing !== null;
  }

  toggle() {
    if (this.#takes.recording) this.stop();
    else this.#tried(() => this.#takes.start(), "Recording");
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
      const found = await this.#takes.list();
      element("takes").replaceChildren(...found.map((one) => this.#row(one)));
      element("no-takes").hidden = found.length > 0;
    } catch {
      element("no-takes").textContent = "This browser keeps no takes here.";
    }
  }

  #row({ id, name, seconds, frames }) {
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
    row.append(
      title, facts,
      button("Play", "play", (made) => this.#play(id, made)),
      button("CSV", "csv", async () => give(`${name}.csv`, liveLinkCsv(await this.#takes.take(id)), "text/csv")),
      button(".glb", "glb", async () => give(`${name}.glb`, this.#animation(await this.#takes.take(id)), "model/gltf-binary")),
      button("Delete", "delete", () => this.#takes.remove(id)),
    );
    return row;
  }

  async #play(id, button) {
    const stopped = this.#playing;
    stopped?.stop();
    if (stopped?.button === button) return;
    const { frames } = await this.#takes.take(id), began = performance.now();
    const playing = { button, stop: () => ((button.textContent = "Play"), (this.#playing = null)) };
    this.#playing = playing;
    button.textContent = "Stop";
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

  #animation(take) {
    const character = this.#character();
    return animatedGlb(character.check, take, character.turnedNodes(take));
  }

  async #tried(act, words = "") {
    try {
      await act();
      if (words) speak(words);
    } catch (error) {
      showProblem("takes", error.message);
    }
  }
}

function give(name, made, type) {
  const address = URL.createObjectURL(new Blob([made], { type }));
  Object.assign(document.createElement("a"), { href: address, download: name.replace(/[\\/:*?"<>|]/g, "-") }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000); // the browser may ask first where to put it
}
