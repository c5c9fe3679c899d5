// The stream view: the character alone, for programs such as OBS that take a page as a source.

const SIZE = /^(\d{1,4})x(\d{1,4})$/;

/** Whether this page was asked for as a stream view: at .../stream, or with ?view=stream. */
export const isStream = () => /\/stream\/?$/.test(location.pathname) || new URLSearchParams(location.search).get("view") === "stream";

/** Lays the page out as its address says; returns whether the character is mirrored, null where the address does not say. */
export function layOutStream() {
  const asked = new URLSearchParams(location.search), root = document.documentElement;
  root.dataset.view = "stream";
  const background = asked.get("background") ?? "transparent";
  const color = /^[0-9a-f]{3,8}$/i.test(background) ? `#${background}` : background;
  root.style.background = CSS.supports("color", color) ? color : "transparent";
  const size = SIZE.exec(asked.get("size") ?? "");
  if (size) ["width", "height"].forEach((side, i) => root.style.setProperty(`--stream-${side}`, `${size[i + 1]}px`));
  const mirror = asked.get("mirror");
  return mirror === null ? null : mirror !== "0";
}
