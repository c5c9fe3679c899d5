// A ZIP archive of stored files whose data begin at multiples of 64 bytes, as .usdz asks for.

const ALIGNED = 64, LOCAL = 0x04034b50, CENTRAL = 0x02014b50, END = 0x06054b50, VERSION = 20, DAY = 0x21; // 1 January 1980
const TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  for (let bit = 0; bit < 8; bit++) byte = byte & 1 ? 0xedb88320 ^ (byte >>> 1) : byte >>> 1;
  return byte;
});

function checksum(data) {
  let sum = ~0;
  for (let i = 0; i < data.length; i++) sum = TABLE[(sum ^ data[i]) & 255] ^ (sum >>> 8);
  return ~sum >>> 0;
}

/** Little-endian numbers of the given sizes in bytes. */
function packed(fields) {
  const bytes = new Uint8Array(fields.reduce((all, [size]) => all + size, 0)), view = new DataView(bytes.buffer);
  let at = 0;
  for (const [size, value] of fields) {
    if (size === 2) view.setUint16(at, value, true);
    else view.setUint32(at, value, true);
    at += size;
  }
  return bytes;
}

/**
 * @param {[string, Uint8Array][]} files names and data, in this order.
 * @returns {Blob}
 */
export function zipArchive(files) {
  const parts = [], directory = [];
  let at = 0;
  const put = (bytes) => (parts.push(bytes), (at += bytes.length));
  for (const [path, data] of files) {
    const name = new TextEncoder().encode(path), start = at;
    const room = (ALIGNED - ((start + 30 + name.length + 4) % ALIGNED)) % ALIGNED; // an extra field of so many bytes
    const sizes = [[4, checksum(data)], [4, data.length], [4, data.length], [2, name.length]];
    const facts = [[2, VERSION], [2, 0], [2, 0], [2, 0], [2, DAY], ...sizes];
    put(packed([[4, LOCAL], ...facts, [2, room + 4]]));
    put(name);
    put(packed([[2, 0x1986], [2, room]]));
    put(new Uint8Array(room));
    put(data);
    directory.push(packed([[4, CENTRAL], [2, VERSION], ...facts, [2, 0], [2, 0], [2, 0], [2, 0], [4, 0], [4, start]]), name);
  }
  const begin = at;
  directory.forEach(put);
  put(packed([[4, END], [2, 0], [2, 0], [2, files.length], [2, files.length], [4, at - begin], [4, begin], [2, 0]]));
  return new Blob(parts);
}
