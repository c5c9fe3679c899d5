// A take on a character as a film: each of its frames is drawn at its own time.

import { mp4, TICKS } from "./mp4_container.js";
import { Stage } from "./stage.js";

const SIZE = { width: 1280, height: 720 };
const CODECS = ["avc1.640028", "avc1.42001f"]; // H.264, high and baseline
const BITS = 6_000_000; // a second
const KEY_EVERY = 60, WAITING = 8; // pictures

/**
 * @param {Character} character of its own, which nothing else poses.
 * @param {Take} take at least one frame.
 * @param {string} background a colour of CSS.
 * @param {(done: number) => void} progress how much is done, of 1.
 * @returns {Promise<Blob>} an MP4; throws where this browser encodes none.
 */
export async function takeFilm(character, take, background, progress) {
  const config = await supported();
  const canvas = Object.assign(document.createElement("canvas"), SIZE), stage = new Stage(canvas, { ...SIZE, background });
  const samples = [];
  let description = null, failed = null;
  const encoder = new VideoEncoder({
    output(chunk, { decoderConfig }) {
      if (decoderConfig?.description) description = new Uint8Array(decoderConfig.description.slice(0));
      const data = new Uint8Array(chunk.byteLength);
      chunk.copyTo(data);
      samples.push({ data, key: chunk.type === "key", ticks: 0 });
    },
    error: (error) => (failed = error),
  });
  encoder.configure(config);
  try {
    stage.show(character);
    for (const [i, frame] of take.frames.entries()) {
      character.pose(frame);
      stage.drawNow();
      const picture = new VideoFrame(canvas, { timestamp: Math.round(1e6 * frame.seconds) });
      encoder.encode(picture, { keyFrame: i % KEY_EVERY === 0 });
      picture.close();
      while (encoder.encodeQueueSize > WAITING && !failed) await new Promise((resolve) => setTimeout(resolve, 5));
      if (failed) throw failed;
      progress(i / take.frames.length);
      if (i % WAITING === 0) await new Promise((resolve) => setTimeout(resolve));
    }
    await encoder.flush();
  } finally {
    if (encoder.state !== "closed") encoder.close();
    stage.dispose();
  }
  const ticks = [...take.seconds, take.duration + 1 / take.rate].map((seconds) => Math.round(TICKS * seconds));
  samples.forEach((sample, i) => (sample.ticks = ticks[i + 1] - ticks[i]));
  return mp4({ ...SIZE, description, samples });
}

async function supported() {
  for (const codec of CODECS) {
    const config = { ...SIZE, codec, bitrate: BITS, avc: { format: "avc" }, latencyMode: "realtime" }; // pictures come in their order
    if ((await globalThis.VideoEncoder?.isConfigSupported(config).catch(() => null))?.supported) return config;
  }
  throw new Error("This browser encodes no H.264. Use Chrome, Edge or Safari for the film, or save .glb.");
}
