// Runs in the page before its own scripts: keeps what goes to the worker and what comes back, what is downloaded, and what
// the page says of itself. While `held` is a list, pictures for the worker wait there.
delete window.MediaStreamTrackProcessor; // so pictures pass through the page, where they can be kept and held
window.watched = { sent: [], solved: [], loaded: [], workers: [], blobs: [], said: [], held: null };
{
  const post = Worker.prototype.postMessage, made = URL.createObjectURL, Original = window.Worker;
  window.Worker = class extends Original {
    constructor(address, options) {
      super(address, options);
      watched.workers.push(String(address));
      this.addEventListener("message", ({ data }) => data.solved && watched.solved.push(data.solved));
      this.addEventListener("message", ({ data }) => "loaded" in data && watched.loaded.push(data));
    }
  };
  Worker.prototype.postMessage = function (message, given) {
    if (message.frame) {
      const { picture, ...rest } = message.frame;
      const { width, height } = picture;
      watched.sent.push({ ...rest, width, height, pixels: watched.keep ? pixels(picture) : null });
    }
    const go = () => post.call(this, message, given);
    if (message.frame && watched.held) watched.held.push(go);
    else go();
  };
  document.addEventListener("DOMContentLoaded", () => {
    const status = document.getElementById("status");
    const keep = () => watched.said.push(status.textContent);
    if (status) new MutationObserver(keep).observe(status, { childList: true, characterData: true, subtree: true });
  });
  const pixels = (picture) => {
    const context = new OffscreenCanvas(picture.width, picture.height).getContext("2d", { willReadFrequently: true });
    context.drawImage(picture, 0, 0);
    return context.getImageData(0, 0, picture.width, picture.height).data;
  };
  URL.createObjectURL = (blob) => (watched.blobs.push(blob), made.call(URL, blob));
  watched.text = async (bytes) => {
    const address = await new Promise((done) => {
      const reader = new FileReader();
      reader.onload = () => done(reader.result);
      reader.readAsDataURL(new Blob([bytes]));
    });
    return address.slice(address.indexOf(",") + 1);
  };
}
