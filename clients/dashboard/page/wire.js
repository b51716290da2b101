// A picture's bytes: their length-prefixed JSON, and the arrays behind it as typed arrays that share
// the message's memory.

const TYPES = { u8: Uint8Array, f32: Float32Array };
// Arrays begin at multiples of this, so that typed arrays can lie on the buffer.
const ALIGNMENT = 8;

/** Decodes a message; `arrays` becomes an object of typed arrays by name. Throws if it is damaged. */
export function decode(buffer) {
  const { text, end } = header(buffer);
  const picture = JSON.parse(text);
  const arrays = {};
  let at = end;
  for (const { name, type, length } of picture.arrays) {
    const Type = TYPES[type];
    if (!Type) throw new Error(`array ${name}: expected type u8 or f32, got ${type}`);
    if (at + length * Type.BYTES_PER_ELEMENT > buffer.byteLength) {
      throw new Error(`array ${name}: expected ${length} values, got ${buffer.byteLength - at} bytes`);
    }
    arrays[name] = new Type(buffer, at, length);
    at += aligned(length * Type.BYTES_PER_ELEMENT);
  }
  checkGrids(picture, arrays);
  return { ...picture, arrays };
}

/** Height and width of the grids in a picture, or null before any is known. */
export function shapeOf(picture) {
  const info = picture?.info;
  return info ? { height: info.height, width: info.width } : null;
}

function header(buffer) {
  if (buffer.byteLength < 4) throw new Error(`picture: expected 4 bytes or more, got ${buffer.byteLength}`);
  const length = new DataView(buffer).getUint32(0, true);
  const end = 4 + length;
  if (end > buffer.byteLength || end % ALIGNMENT !== 0) {
    throw new Error(`picture: expected a header within ${buffer.byteLength} bytes, got ${end}`);
  }
  return { text: new TextDecoder().decode(new Uint8Array(buffer, 4, length)), end };
}

// A grid of another size would be painted askew, so it is refused instead.
function checkGrids(picture, arrays) {
  const shape = shapeOf(picture);
  if (!shape) return;
  const cells = shape.height * shape.width;
  for (const name of ["truth", "frame", "seen", "age", "entropy"]) {
    if (arrays[name] && arrays[name].length !== cells) {
      throw new Error(`array ${name}: expected ${cells} cells, got ${arrays[name].length}`);
    }
  }
  if (arrays.belief && arrays.belief.length % cells !== 0) {
    throw new Error(`array belief: expected a multiple of ${cells}, got ${arrays.belief.length}`);
  }
}

function aligned(bytes) {
  return Math.ceil(bytes / ALIGNMENT) * ALIGNMENT;
}
