// The container of a .glb: its JSON and its buffer, in and out.

const MAGIC = 0x46546c67, JSON_CHUNK = 0x4e4f534a, BINARY_CHUNK = 0x004e4942;

/** What the page says of a file that it cannot use. */
export class CharacterError extends Error {}

/**
 * Takes a .glb apart.
 *
 * @param {ArrayBuffer} bytes the whole file.
 * @returns {{document: object, binary: Uint8Array}} its JSON and the buffer behind it.
 */
export function readGlb(bytes) {
  const view = new DataView(bytes);
  if (bytes.byteLength < 20 || view.getUint32(0, true) !== MAGIC)
    throw new CharacterError("This is no .glb file. Export the character as binary glTF 2.0 (.glb).");
  if (view.getUint32(4, true) !== 2)
    throw new CharacterError(`This is glTF version ${view.getUint32(4, true)}; the page reads version 2.`);
  if (view.getUint32(8, true) > bytes.byteLength) throw new CharacterError("The file is cut short. Copy it once more.");
  let document = null;
  let binary = new Uint8Array(0);
  for (let at = 12; at + 8 <= bytes.byteLength; ) {
    const size = view.getUint32(at, true), kind = view.getUint32(at + 4, true);
    if (at + 8 + size > bytes.byteLength) throw new CharacterError("The file is cut short. Copy it once more.");
    const chunk = new Uint8Array(bytes, at + 8, size);
    if (kind === JSON_CHUNK && document === null) document = parsed(chunk);
    else if (kind === BINARY_CHUNK && binary.length === 0) binary = chunk;
    at += 8 + size;
  }
  if (document === null || typeof document !== "object") throw new CharacterError("The file holds no glTF document.");
  return { document, binary };
}

function parsed(chunk) {
  try {
    return JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(chunk));
  } catch {
    throw new CharacterError("The file's JSON is damaged. Export the character once more.");
  }
}

/** Puts a .glb together; `document.buffers[0]` gets the buffer's size. */
export function writeGlb(document, binary) {
  const padded = (size) => Math.ceil(size / 4) * 4;
  document = { ...document, buffers: [{ ...document.buffers?.[0], byteLength: binary.length }, ...(document.buffers?.slice(1) ?? [])] };
  const json = new TextEncoder().encode(JSON.stringify(document));
  const total = 12 + 8 + padded(json.length) + 8 + padded(binary.length);
  const bytes = new Uint8Array(total), view = new DataView(bytes.buffer);
  [MAGIC, 2, total, padded(json.length), JSON_CHUNK].forEach((word, i) => view.setUint32(4 * i, word, true));
  bytes.fill(0x20, 20, 20 + padded(json.length)); // JSON is padded with blanks
  bytes.set(json, 20);
  const at = 20 + padded(json.length);
  view.setUint32(at, padded(binary.length), true);
  view.setUint32(at + 4, BINARY_CHUNK, true);
  bytes.set(binary, at + 8);
  return bytes;
}
