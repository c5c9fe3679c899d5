// An MP4 of one H.264 stream, put together of encoded pictures: ISO/IEC 14496-12, with the boxes that players ask for.

export const TICKS = 90_000; // a second

const text = (word) => new TextEncoder().encode(word);
const u16 = (...values) => values.flatMap((value) => [(value >> 8) & 255, value & 255]);
const u32 = (...values) => values.flatMap((value) => [(value >>> 24) & 255, (value >>> 16) & 255, (value >>> 8) & 255, value & 255]);
const zeros = (count) => new Array(count).fill(0);
const IDENTITY = u32(0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000);

function box(name, ...parts) {
  const body = parts.map((part) => (part instanceof Uint8Array ? part : Uint8Array.from(part)));
  const size = body.reduce((all, part) => all + part.length, 8), made = new Uint8Array(size);
  made.set(u32(size));
  made.set(text(name), 4);
  let at = 8;
  for (const part of body) {
    made.set(part, at);
    at += part.length;
  }
  return made;
}

/**
 * @param {{width: number, height: number, description: Uint8Array, samples: {data: Uint8Array, ticks: number, key: boolean}[]}} film
 *   the decoder's description (avcC), and pictures in their order, each shown for so many ticks.
 * @returns {Blob}
 */
export function mp4({ width, height, description, samples }) {
  const length = samples.reduce((all, { ticks }) => all + ticks, 0);
  const runs = []; // of samples that are shown equally long
  for (const { ticks } of samples) {
    if (runs.at(-1)?.[1] === ticks) runs.at(-1)[0] += 1;
    else runs.push([1, ticks]);
  }
  const keys = samples.flatMap(({ key }, i) => (key ? [i + 1] : []));
  const head = box("ftyp", text("isom"), u32(512), text("isomiso2avc1mp41"));
  const coded = box("avc1", zeros(6), u16(1), zeros(16), u16(width, height), u32(0x480000, 0x480000, 0), u16(1), zeros(32), u16(24, 0xffff), box("avcC", description));
  const movie = (offset) => box("moov",
    box("mvhd", u32(0, 0, 0, TICKS, length, 0x10000), u16(0x100), zeros(10), IDENTITY, zeros(24), u32(2)),
    box("trak",
      box("tkhd", u32(3, 0, 0, 1, 0, length), zeros(8), u16(0, 0, 0, 0), IDENTITY, u32(width << 16, height << 16)),
      box("mdia",
        box("mdhd", u32(0, 0, 0, TICKS, length), u16(0x55c4, 0)),
        box("hdlr", u32(0, 0), text("vide"), zeros(12), text("video\0")),
        box("minf", box("vmhd", u32(1), zeros(8)), box("dinf", box("dref", u32(0, 1), box("url ", u32(1)))),
          box("stbl", box("stsd", u32(0, 1), coded),
            box("stts", u32(0, runs.length, ...runs.flat())), box("stss", u32(0, keys.length, ...keys)),
            box("stsc", u32(0, 1, 1, samples.length, 1)),
            box("stsz", u32(0, 0, samples.length), samples.flatMap(({ data }) => u32(data.length))),
            box("stco", u32(0, 1, offset)))))));
  const bytes = samples.reduce((all, { data }) => all + data.length, 8);
  const moov = movie(head.length + movie(0).length + 8);
  return new Blob([head, moov, Uint8Array.from(u32(bytes)), text("mdat"), ...samples.map(({ data }) => data)], { type: "video/mp4" });
}
