// What the worker does: pictures in, weights out, through one graph whose state goes from frame to frame.

const FIRST_INTERVAL = 1 / 30; // seconds, of a frame that none came before
const LONGEST_INTERVAL = 10; // seconds: after a longer pause all that time smooths is forgotten anyway
/** A graph that does nothing: with it the runtime is loaded and compiled while the graph is still on its way. */
const IDENTITY = Uint8Array.from(atob("CAc6LwoQCgFhEgFiIghJZGVudGl0eRIBZ1oLCgFhEgYKBAgBEgBiCwoBYhIGCgQIARIAQgQKABAN"), (one) => one.charCodeAt(0));
/** Steps of loading: the graph and the runtime are here, the session is made, a first picture has been through. */
export const PARTS = 4;
const BLANK = 128; // pixels a side of the first picture
const POSE = 0, GAIN = 1, SMOOTHING = 2, RESET = 3;

async function fetched(graph, tell) {
  const answer = await fetch(graph);
  if (!answer.ok) throw new Error(`${new URL(graph).pathname} was not found (status ${answer.status})`);
  let bytes = 0;
  const counted = new TransformStream({ transform: (part, to) => (tell((bytes += part.length)), to.enqueue(part)) });
  const unpacked = answer.body.pipeThrough(counted).pipeThrough(new DecompressionStream("gzip"));
  return inPlace(new Uint8Array(await new Response(unpacked).arrayBuffer()));
}

/** The bytes of numbers of four, of which the first ones stand before the second ones: gzip makes less of them so. */
function inPlace(bytes) {
  const count = bytes.length / 4, found = new Uint8Array(bytes.length);
  for (let i = 0, to = 0; i < count; i++) for (let from = i; from < bytes.length; from += count) found[to++] = bytes[from];
  return found;
}

/**
 * Answers the page's messages.
 *
 * - `{load: {graph, mjs, wasm, threads}}` with addresses, is answered by `{ready: {engine, threads}}`, and before by
 *   `{loaded: parts, bytes}` for each of `PARTS` and while the graph comes, of which so many bytes are here;
 * - `{frame: {number, time, picture, pose, gain, smoothing, reset}}`, a picture of any size that is given away, its time
 *   in milliseconds, by `{solved: {number, time, interval, ..., milliseconds, width, height}}`;
 * - `{follow: pictures}`, a stream of a camera's pictures, by such answers to them, and by `{left: true}` when it ends;
 * - `{controls: {pose, gain, smoothing, reset} | null}` says how those are solved; without them they are let go;
 * - whatever fails by `{failed: words}`.
 *
 * @param {object} ort of onnxruntime-web.
 * @param {string} engine its execution provider.
 */
export function answerFrames(ort, engine) {
  const canvas = new OffscreenCanvas(1, 1);
  const context = canvas.getContext("2d", { willReadFrequently: true, alpha: false });
  let session = null, state = null, before = null, wanted = null;

  async function load({ graph, mjs, wasm, threads }) {
    ort.env.wasm.wasmPaths = { mjs, wasm };
    ort.env.wasm.numThreads = threads;
    ort.env.logLevel = "error";
    const options = {
      executionProviders: [engine],
      graphOptimizationLevel: "disabled", // what is loaded is optimised
      executionMode: "parallel", // else the making of the session looks for memory to be used again, in a time that grows with the square
      logSeverityLevel: 3, // errors alone
    };
    let parts = 0, bytes = 0;
    const tell = () => self.postMessage({ loaded: parts, bytes });
    const done = (value) => (parts++, tell(), value);
    const [content] = await Promise.all([fetched(graph, (here) => ((bytes = here), tell())).then(done), ort.InferenceSession.create(IDENTITY, options).then(done)]);
    session = done(await ort.InferenceSession.create(content, options));
    const size = session.inputMetadata.find((input) => input.name === "state").shape[0];
    state = new ort.Tensor("float32", new Float32Array(size), [size]);
    const blank = new Uint8Array(4 * BLANK * BLANK);
    await run(blank, BLANK, BLANK, FIRST_INTERVAL, new Float32Array(5)); // the first run compiles and allocates
    return { ready: { engine, threads: ort.env.wasm.numThreads } };
  }

  async function solve({ number, time, picture, pose, gain, smoothing, reset }) {
    const started = performance.now();
    const { width, height, pixels } = await read(picture);
    const interval = before === null ? FIRST_INTERVAL : Math.min((time - before) / 1000, LONGEST_INTERVAL);
    before = time;
    const controls = new Float32Array(5);
    controls[POSE] = pose;
    controls[GAIN] = gain;
    controls[SMOOTHING] = smoothing;
    controls[RESET] = reset ? 1 : 0;
    const found = await run(pixels, width, height, interval, controls);
    state = found.next_state;
    const numbers = (name) => Float32Array.from(found[name].data);
    return {
      solved: {
        number, time, interval, width, height,
        weights: numbers("weights"), rotation: numbers("rotation"), translation: numbers("translation"),
        gaze: numbers("gaze"), beside: numbers("beside"), landmarks: numbers("landmarks"), iris: numbers("iris"),
        presence: found.presence.data[0], calibrated: found.calibrated.data[0],
        milliseconds: performance.now() - started,
      },
    };
  }

  const run = (pixels, width, height, interval, controls) =>
    session.run({
      image: new ort.Tensor("uint8", pixels, [height, width, 4]),
      interval: new ort.Tensor("float32", new Float32Array([interval]), []),
      controls: new ort.Tensor("float32", controls, [5]),
      state,
    });

  async function follow(pictures) {
    const reader = pictures.getReader();
    for (;;) {
      const { value: picture, done } = await reader.read();
      if (done) return { left: true };
      if (wanted === null) {
        picture.close();
        continue;
      }
      const controls = wanted;
      wanted = { ...controls, reset: false };
      self.postMessage(await solve({ number: 0, time: picture.timestamp / 1000, picture, ...controls }));
    }
  }

  async function read(picture) {
    if (picture instanceof VideoFrame && !picture.rotation && !picture.flip) {
      const { width, height } = picture.visibleRect, pixels = new Uint8Array(4 * width * height);
      await picture.copyTo(pixels, { format: "RGBA" });
      picture.close();
      return { width, height, pixels };
    }
    const width = picture.displayWidth ?? picture.width, height = picture.displayHeight ?? picture.height;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    context.drawImage(picture, 0, 0);
    picture.close();
    return { width, height, pixels: new Uint8Array(context.getImageData(0, 0, width, height).data.buffer) };
  }

  self.onmessage = async ({ data }) => {
    try {
      if ("controls" in data) wanted = data.controls;
      else self.postMessage(data.load ? await load(data.load) : data.follow ? await follow(data.follow) : await solve(data.frame));
    } catch (error) {
      self.postMessage({ failed: String(error?.message ?? error) });
    }
  };
}
