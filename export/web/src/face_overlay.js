// The landmarks over the camera's picture.

const LINES = [
  [0, 16], [17, 21], [22, 26], [27, 30], [31, 35], // jaw, brows, nose
  [36, 41, 36], [42, 47, 42], [48, 59, 48], [60, 67, 60], // eyes and lips, closed
];

/**
 * Draws one answer; clears where there is no face.
 *
 * @param {HTMLCanvasElement} canvas over the video.
 * @param {object | null} solved what the graph says of the picture.
 */
export function drawFace(canvas, solved) {
  const context = canvas.getContext("2d");
  const [width, height] = solved ? [solved.width, solved.height] : [canvas.width, canvas.height];
  if (canvas.width !== width || canvas.height !== height) {
    [canvas.width, canvas.height] = [width, height];
    canvas.parentElement.style.aspectRatio = `${width} / ${height}`; // no bands beside the picture
  }
  context.clearRect(0, 0, width, height);
  if (!solved || !Number.isFinite(solved.landmarks[0])) return;
  const at = (i) => [solved.landmarks[2 * i] + 0.5, solved.landmarks[2 * i + 1] + 0.5]; // pixels' centres are at integers
  context.globalAlpha = Math.max(0.25, Math.min(1, solved.presence));
  for (const [color, thickness] of [["rgb(0 0 0 / 55%)", 3], ["rgb(120 230 255)", 1.25]]) {
    context.strokeStyle = color;
    context.lineWidth = (thickness * width) / 640;
    context.beginPath();
    for (const [first, last, back] of LINES) {
      context.moveTo(...at(first));
      for (let i = first + 1; i <= last; i++) context.lineTo(...at(i));
      if (back !== undefined) context.closePath();
    }
    for (const eye of [0, 1]) {
      const [x, y] = [solved.iris[2 * eye] + 0.5, solved.iris[2 * eye + 1] + 0.5];
      if (!Number.isFinite(x)) continue;
      context.moveTo(x + width / 200, y);
      context.arc(x, y, width / 200, 0, 2 * Math.PI);
    }
    context.stroke();
  }
  context.globalAlpha = 1;
}
