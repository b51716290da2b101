// Makes the panels as large as fits. Uses whole screen pixels per cell if that makes the panels only a little smaller.
// In the "regular" layout, the truth, the observations and the inspector form the first row; the beliefs and the
// entropy form the second. Any other layout places all panels in order, and the inspector last.

// A whole number of pixels per cell is crisper. It is used if the panel then keeps at least this share of its size.
const WORTHWHILE = 0.8;
// A regular layout reads best. Another layout is chosen only if its panels are larger by this factor.
const REGULAR_MERIT = 1.15;
// Sizes in rem, as in the style sheet: the inspector's title, one of its lines, its columns of lines and the gap
// between them, the minimum width of a panel's column (for the caption), and the note in place of beliefs.
const TITLE = 1.7;
const LINE = 1.72;
const LANE = 9;
const LANE_GAP = 1.2;
const CAPTION_WIDTH = 8;
const NOTE = 5;
// Minimum panel width in rem. If the panels do not fit at this width, they keep a readable size and their field scrolls.
const MIN_WIDTH = 4;
// Number of panels before the inspector in a regular layout.
const OBSERVED = 3;

/**
 * Returns the best layout of panels within `area`: columns, the panels' size in CSS pixels, the inspector's span.
 * `places` has the numbers of panels, of inspector lines and of columns in a regular layout. If `isBare` is set, a note
 * replaces the beliefs. If the area's height is Infinity, the page or the field scrolls, and the layout has `forced` columns.
 */
export function fit({ area, shape, places, forced, gap, caption, ratio, rem }) {
  const minimum = CAPTION_WIDTH * rem + gap;
  const maximum = Math.max(2, Math.floor((area.width + gap) / minimum));
  const choices = area.height === Infinity ? [forced] : range(2, Math.min(places.panels + 1, maximum));
  let best = null;
  for (const columns of choices) {
    const placed = place(columns, places);
    const size = sizeFor({ area, shape, placed, gap, caption, ratio, rem, lines: places.lines });
    const merit = size.width * (placed.isRegular ? REGULAR_MERIT : 1);
    if (!best || merit > best.merit) best = { ...placed, ...size, merit };
  }
  return best;
}

function place(columns, { panels, regular, isBare }) {
  const isRegular = columns === regular;
  if (isRegular) return { columns, isRegular, hasNote: false, span: columns - OBSERVED, rows: 1 + Math.ceil((panels - OBSERVED || 1) / columns) };
  const over = panels % columns;
  return { columns, isRegular, hasNote: isBare, span: columns - over, rows: Math.floor(panels / columns) + 1 };
}

// The inspector's row may need to be higher than the panels, which then shrink. In a regular layout, the note fills the
// beliefs' row; otherwise it has its own row.
function sizeFor({ area, shape, placed, gap, caption, ratio, rem, lines }) {
  const height = area.height - (placed.rows - 1) * gap - (placed.hasNote ? NOTE * rem + gap : 0);
  const free = { x: (area.width - (placed.columns - 1) * gap) / placed.columns, y: height / placed.rows - caption };
  const size = sized(free, shape, ratio);
  const width = placed.span * (size.width + gap) - gap;
  const lanes = Math.max(1, Math.floor((width / rem + LANE_GAP) / (LANE + LANE_GAP)));
  const inspector = (TITLE + LINE * Math.ceil(lines / lanes)) * rem;
  const excess = inspector - (size.height + caption);
  if (excess <= 0 || area.height === Infinity || placed.rows === 1) return size;
  const left = (height - inspector) / (placed.rows - 1) - caption;
  return sized({ x: free.x, y: Math.min(free.y, left) }, shape, ratio);
}

function sized(free, { height, width }, ratio) {
  const scale = Math.max(0, Math.min(free.x / width, free.y / height)) * ratio;
  const crisp = Math.floor(scale);
  const used = crisp >= scale * WORTHWHILE && crisp >= 1 ? crisp : scale;
  return { width: (used * width) / ratio, height: (used * height) / ratio, isCrisp: used >= 1 };
}

function range(from, to) {
  return Array.from({ length: to - from + 1 }, (_, i) => from + i);
}

export function createLayout({ stage, field, panels }, places) {
  let sizes = "";

  function layOut(shape) {
    // Narrower layouts wrap legends into more lines, so the calculation assumes the legends' greatest height.
    stage.style.removeProperty("--field-width");
    let others = -1;
    for (let used = usedByOthers(); used > others; used = usedByOthers()) {
      others = used;
      fitBeside(others, shape);
    }
  }

  function fitBeside(others, shape) {
    const style = getComputedStyle(stage);
    const number = (name) => parseFloat(style.getPropertyValue(name));
    const isStacked = number("--stacked") === 1;
    const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const gap = parseFloat(getComputedStyle(panels).columnGap);
    const width = stage.clientWidth - (isStacked ? 0 : number("--charts") * rem + parseFloat(style.columnGap));
    const height = isStacked ? Infinity : stage.clientHeight - others;
    const caption = number("--caption") * rem;
    const fitted = (height, forced) => fit({
      area: { width, height }, shape, places: places(), forced, gap, caption, ratio: devicePixelRatio, rem,
    });
    let best = fitted(height, number("--columns"));
    const isCramped = best.width < MIN_WIDTH * rem;
    if (isCramped) best = fitted(Infinity, number("--columns"));
    field.classList.toggle("is-cramped", isCramped);
    const share = (width + gap) / best.columns - gap;
    apply(best, gap, isStacked ? share : Math.max(best.width, CAPTION_WIDTH * rem));
  }

  function usedByOthers() {
    const rowGap = parseFloat(getComputedStyle(field).rowGap);
    const others = [...field.children].filter((child) => child !== panels && child.offsetHeight > 1);
    return others.reduce((sum, child) => sum + child.offsetHeight + rowGap, 0);
  }

  function apply({ width, height, columns, span, isCrisp, isRegular }, gap, column) {
    stage.style.setProperty("--column-width", `${column}px`);
    stage.style.setProperty("--panel-width", `${width}px`);
    stage.style.setProperty("--panel-height", `${height}px`);
    stage.style.setProperty("--panel-columns", columns);
    stage.style.setProperty("--inspector-span", span);
    stage.style.setProperty("--field-width", `${columns * (column + gap) - gap}px`);
    panels.classList.toggle("is-smooth", !isCrisp);
    panels.classList.toggle("is-regular", isRegular);
  }

  const sizeOf = () => [stage.clientWidth, stage.clientHeight, devicePixelRatio].join();

  return {
    /** Fits panels of this shape, if the panels or legends (`isChanged`) or the stage's size have changed. */
    draw(shape, isChanged) {
      if (stage.clientWidth === 0 || (!isChanged && sizeOf() === sizes)) return;
      layOut(shape);
      sizes = sizeOf();
    },
  };
}
