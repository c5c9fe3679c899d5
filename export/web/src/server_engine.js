// The engine behind a socket: `torchface live` solves, sends on and records; this page shows and says what is wanted.

import { isStream } from "./stream_view.js";
import { Take } from "./take.js";

const FRAME = 1, PICTURE = 2; // first number of a message
const PART = 2 ** 15; // bytes of a take in a message
const AGAIN = 1000; // milliseconds until a lost connection is tried again
const PARTS = {
  weights: 52, rotation: 9, gaze: 4, landmarks: 136, iris: 4, beside: 2,
  presence: 1, calibrated: 1, interval: 1, milliseconds: 1, width: 1, height: 1,
};

export class ServerEngine {
  #page;
  #picture;
  #socket = null;
  #ended = false;
  #lost = false;
  #sent = "";
  #names = {};
  running = false;
  threads = 1;

  /**
   * @param {object} page as for `CameraEngine`, and `state(state)`.
   * @param {HTMLCanvasElement} picture where the camera's pictures are shown.
   */
  constructor(page, picture) {
    [this.#page, this.#picture] = [page, picture];
    this.takes = new ServerTakes((message) => this.#send(message));
  }

  start() {
    const address = new URL("./socket", document.baseURI);
    address.protocol = "ws:";
    this.#socket = new WebSocket(address);
    this.#socket.binaryType = "arraybuffer";
    this.#socket.onopen = () => {
      if (this.#lost && isStream()) return location.reload(); // torchface was started again, with what may be another character
      this.#sent = "";
      this.sendControls();
      this.nameShapes(this.#names);
    };
    this.#socket.onmessage = ({ data }) => (typeof data === "string" ? this.#take(JSON.parse(data)) : this.#show(data));
    this.#socket.onclose = () => {
      this.#set(false);
      this.#lost = true;
      if (this.#ended && !isStream()) return; // the page's address goes with the program, that of the stream view stays
      this.#page.status("torchface does not answer: it has ended, or is busy.");
      setTimeout(() => this.start(), AGAIN);
    };
  }

  stop() {} // torchface ends with Ctrl+C

  reset() {
    this.#send({ reset: true });
  }

  /** Sends what the user set, where that is another than before. */
  sendControls() {
    const message = JSON.stringify({ controls: this.#page.controls() });
    if (message === this.#sent || this.#socket?.readyState !== WebSocket.OPEN) return;
    this.#sent = message;
    this.#socket.send(message);
  }

  /** Says what names of the shapes of torchface's character mean, for what it records. */
  nameShapes(names) {
    this.#names = names;
    if (this.#socket?.readyState === WebSocket.OPEN) this.#send({ names });
  }

  #send(message) {
    if (this.#socket?.readyState !== WebSocket.OPEN) throw new Error("torchface does not answer.");
    this.#socket.send(message instanceof Uint8Array ? message : JSON.stringify(message));
  }

  #set(running) {
    if (this.running === running) return;
    this.running = running;
    this.#page.running(running);
  }

  #take(state) {
    if (state.ended) this.#ended = true;
    if (this.takes.update(state)) this.#page.takesChanged();
    this.#page.state(state);
  }

  async #show(data) {
    const kind = new Uint32Array(data, 0, 1)[0];
    if (kind === PICTURE) return this.#draw(new Blob([data.slice(8)], { type: "image/jpeg" }));
    if (kind !== FRAME) return;
    this.#set(true);
    const numbers = new Float32Array(data, 16), solved = { time: new Float64Array(data, 8, 1)[0] };
    let at = 0;
    for (const [name, count] of Object.entries(PARTS)) {
      solved[name] = count === 1 ? numbers[at] : numbers.subarray(at, at + count);
      at += count;
    }
    this.#page.show(solved, solved);
    this.sendControls();
  }

  async #draw(jpeg) {
    const picture = await createImageBitmap(jpeg), canvas = this.#picture;
    if (canvas.width !== picture.width || canvas.height !== picture.height)
      [canvas.width, canvas.height] = [picture.width, picture.height];
    canvas.getContext("2d").drawImage(picture, 0, 0);
    document.documentElement.dataset.pictures = "on";
    picture.close();
  }
}

/** Takes that torchface records into its folder. */
class ServerTakes {
  #send;
  #list = [];
  recording = null;

  constructor(send) {
    this.#send = send;
  }

  /** Takes what torchface says of them; whether the list is another one. */
  update({ recording, takes }) {
    this.recording = recording ?? null;
    if (!takes || JSON.stringify(takes) === JSON.stringify(this.#list)) return false;
    this.#list = takes;
    return true;
  }

  start(filmed = false) {
    this.#send({ record: true, film: filmed });
    this.recording = { seconds: 0, frames: 0 };
  }

  stop() {
    this.#send({ record: false });
    this.recording = null;
  }

  list() {
    return this.#list;
  }

  async take(id) {
    return Take.ofRows(new Float32Array(await (await this.#file(id)).arrayBuffer()));
  }

  async film(id) {
    return (await this.#file(id, "/film")).blob();
  }

  async #file(id, part = "") {
    const answer = await fetch(`./takes/${encodeURIComponent(id)}${part}`);
    if (!answer.ok) throw new Error(`${id}: ${await answer.text()}`);
    return answer;
  }

  keep(name, take) {
    const bytes = new Uint8Array(take.rows.buffer);
    this.#send({ keep: name, bytes: bytes.length });
    for (let at = 0; at < bytes.length; at += PART) this.#send(bytes.subarray(at, at + PART));
  }

  /** Has the film of a take solved once more, with more time. */
  solve(id) {
    this.#send({ solve: id });
  }

  rename(id, name) {
    this.#send({ rename: [id, name] });
  }

  remove(id) {
    this.#send({ remove: id });
  }
}
