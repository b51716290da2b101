// How large panels are: as large as fits, in whole screen pixels per cell where that costs little.
//
// Where there is room, the beliefs and the entropy share one row, below the row of what is observed
// with the inspector at its end ("regular"); else panels follow each other and the inspector comes last.

// A whole number of pixels per cell is crisper; beyond this loss of size it is not worth it.
const WORTHWHILE = 0.8;
// A regular layout reads best: another must be larger by this to be preferred.
const REGULAR_MERIT = 1.15;
// Heights and widths of the inspector's parts, in rem: its title, a line, and when lines part in two columns.
const TITLE = 1.7;
const LINE = 1.72;
const TWO_COLUMNS = 19;
// Panels before the inspector in a regular layout.
const OBSERVED = 3;

/**
 * The best layout of panels within `area`: columns, the panels' size in CSS pixels, the inspector's span.
 *
 * `places` counts panels, the inspector's lines, and the columns of a regular layout. In an area of
 * height Infinity the page scrolls and `forced` columns are taken.
 */
export function fit({ area, shape, places, forced, gap, caption, ratio, rem }) {
  const choices = area.height === Infinity ? [forced] : range(2, places.panels + 1);
  let best = null;
  for (const columns of choices) {
    const placed = place(columns, places);
    const size = sizeFor({ area, shape, placed, gap, caption, ratio, rem, lines: places.lines });
    const merit = size.width * (placed.isRegular ? REGULAR_MERIT : 1);
    if (!best || merit > best.merit) best = { ...placed, ...size, merit };
  }
  return best;
}

function place(columns, { panels, regular }) {
  const isRegular = columns === regular;
  if (isRegular) return { columns, isRegular, span: columns - OBSERVED, rows: 1 + Math.ceil((panels - OBSERVED || 1) / columns) };
  const over = panels % columns;
  return { columns, isRegular, span: columns - over, rows: Math.floor(panels / columns) + 1 };
}

// The row that the inspector is in may have to be higher than the panels: then they give way.
function sizeFor({ area, shape, placed, gap, caption, ratio, rem, lines }) {
  const free = {
    x: (area.width - (placed.columns - 1) * gap) / placed.columns,
    y: (area.height - (placed.rows - 1) * gap) / placed.rows - caption,
  };
  const size = sized(free, shape, ratio);
  const width = placed.span * (size.width + gap) - gap;
  const inspector = (TITLE + LINE * Math.ceil(lines / (width >= TWO_COLUMNS * rem ? 2 : 1))) * rem;
  const excess = inspector - (size.height + caption);
  if (excess <= 0 || area.height === Infinity || placed.rows === 1) return size;
  const left = (area.height - inspector - (placed.rows - 1) * gap) / (placed.rows - 1) - caption;
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

/** Keeps `panels` fitted within `stage`: call `layOut()` after anything that changes how much fits. */
export function createLayout({ stage, field, panels }, places) {
  let shape = null;

  function layOut() {
    if (!shape || stage.clientWidth === 0) return;
    const style = getComputedStyle(stage);
    const number = (name) => parseFloat(style.getPropertyValue(name));
    const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const gap = parseFloat(getComputedStyle(panels).columnGap);
    const fitted = fit({
      area: number("--stacked") ? { width: stage.clientWidth, height: Infinity } : beside(style, number("--charts") * rem),
      shape, places: places(), forced: number("--columns"), gap, caption: number("--caption") * rem, ratio: devicePixelRatio, rem,
    });
    apply(fitted, gap);
  }

  // What legends and charts leave.
  function beside(style, chartsWidth) {
    const rowGap = parseFloat(getComputedStyle(field).rowGap);
    const others = [...field.children].filter((child) => child !== panels && child.offsetHeight > 1);
    const used = others.reduce((sum, child) => sum + child.offsetHeight + rowGap, 0);
    return { width: stage.clientWidth - chartsWidth - parseFloat(style.columnGap), height: stage.clientHeight - used };
  }

  function apply({ width, height, columns, span, isCrisp, isRegular }, gap) {
    stage.style.setProperty("--panel-width", `${width}px`);
    stage.style.setProperty("--panel-height", `${height}px`);
    stage.style.setProperty("--panel-columns", columns);
    stage.style.setProperty("--inspector-span", span);
    stage.style.setProperty("--field-width", `${columns * (width + gap) - gap}px`);
    panels.classList.toggle("is-smooth", !isCrisp);
    panels.classList.toggle("is-regular", isRegular);
  }

  new ResizeObserver(layOut).observe(stage);
  return {
    layOut,
    shape(next) { shape = next; layOut(); },
  };
}
