// The webcam, and what can be wrong with it in words that say what to do.

export class CameraError extends Error {}

const WORDS = {
  NotAllowedError:
    "The browser may not use the camera. Allow it (the camera symbol beside the address, or the system's privacy " +
    "settings), then press Start camera again.",
  NotFoundError: "No camera was found. Plug one in, then press Start camera again.",
  NotReadableError: "The camera cannot be opened; another program may be using it. Close that, then try again.",
  AbortError: "The camera stopped before it gave a picture. Try again.",
};
const SILENT_AFTER = 15_000; // milliseconds without a picture after which a camera counts as silent

/**
 * Opens the camera into a video element.
 *
 * @param {HTMLVideoElement} video where its pictures are shown.
 * @param {() => void} ended called when the camera goes away by itself.
 * @returns {Promise<MediaStream>} for `closeCamera`.
 */
export async function openCamera(video, ended) {
  if (!navigator.mediaDevices?.getUserMedia)
    throw new CameraError(
      window.isSecureContext
        ? "This browser cannot reach a camera. Use a current Chrome, Edge, Firefox or Safari."
        : "A camera works only over https or on localhost. Open the page from such an address.",
    );
  let stream;
  try {
    const wanted = { facingMode: "user", width: { ideal: 640 }, height: { ideal: 480 }, frameRate: { ideal: 30 } };
    stream = await navigator.mediaDevices.getUserMedia({ video: wanted, audio: false });
  } catch (error) {
    throw new CameraError(WORDS[error.name] ?? `The camera cannot be opened (${error.message || error.name}).`);
  }
  stream.getVideoTracks()[0].addEventListener("ended", ended);
  video.srcObject = stream;
  try {
    await firstPicture(video);
  } catch (error) {
    closeCamera(video, stream);
    throw error;
  }
  return stream;
}

export function closeCamera(video, stream) {
  for (const track of stream.getTracks()) track.stop();
  video.srcObject = null;
}

function firstPicture(video) {
  return new Promise((resolve, reject) => {
    const silent = new CameraError("The camera gives no pictures. Open its cover, unplug it and plug it in, or restart.");
    const timer = setTimeout(() => reject(silent), SILENT_AFTER);
    const done = () => (clearTimeout(timer), resolve());
    video.addEventListener("loadeddata", done, { once: true }); // in a hidden tab too, where no frame is shown
    video.play().catch(() => {}); // one that may not play gives no picture, which the timer tells
  });
}

/** Calls once for the video's next picture, with its time in milliseconds of the page's clock. */
export function onFrame(video, call) {
  if (video.requestVideoFrameCallback)
    video.requestVideoFrameCallback((now, facts) => call(facts.captureTime ?? now));
  else requestAnimationFrame((now) => (video.readyState >= 2 ? call(now) : onFrame(video, call)));
}
