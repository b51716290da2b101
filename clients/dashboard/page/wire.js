// Decodes a picture's bytes: length-prefixed JSON, followed by arrays, which become typed arrays that share the
// message's memory.

const TYPES = { u8: Uint8Array, f32: Float32Array };
// Arrays begin at multiples of this, so that typed arrays can share the buffer.
const ALIGNMENT = 8;

/** Decodes a message. `arrays` becomes an object of typed arrays by name. Throws if the message is damaged. */
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

/**
 * Returns the height and width of the grids in a picture, or null before they are known. The shown entry's shape
 * takes precedence, because the entry may come from an earlier server with another grid.
 */
export function shapeOf(picture) {
  const of = picture?.shown?.height ? picture.shown : picture?.info;
  return of ? { height: of.height, width: of.width } : null;
}

export function cellsOf(picture) {
  const shape = shapeOf(picture);
  return shape && shape.height * shape.width;
}

export function mapsOf({ info, arrays }) {
  return arrays.maps ? info.maps : [];
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

// Throws if a grid has another size, because it would be drawn askew.
function checkGrids(picture, arrays) {
  const cells = cellsOf(picture);
  if (!cells) return;
  for (const name of ["truth", "frame", "seen", "age", "entropy", "no_fly"]) {
    if (arrays[name] && arrays[name].length !== cells) {
      throw new Error(`array ${name}: expected ${cells} cells, got ${arrays[name].length}`);
    }
  }
  for (const name of ["belief", "maps"]) {
    if (arrays[name] && arrays[name].length % cells !== 0) {
      throw new Error(`array ${name}: expected a multiple of ${cells}, got ${arrays[name].length}`);
    }
  }
}

function aligned(bytes) {
  return Math.ceil(bytes / ALIGNMENT) * ALIGNMENT;
}
