// How large panels are: as large as fits, in whole screen pixels per cell where that costs little.

// A whole number of pixels per cell is crisper; beyond this loss of size it is not worth it.
const WORTHWHILE = 0.8;

/**
 * Columns and the panels' size in CSS pixels for `count` places in an area.
 *
 * `area.height` may be Infinity: then the page scrolls and `columns` are taken as they are.
 */
export function fit({ area, shape, count, columns, gap, caption, ratio }) {
  const choices = area.height === Infinity ? [columns] : range(Math.min(2, count), count);
  let best = null;
  for (const choice of choices) {
    const rows = Math.ceil(count / choice);
    const free = {
      x: (area.width - (choice - 1) * gap) / choice,
      y: (area.height - (rows - 1) * gap) / rows - caption,
    };
    const size = sized(free, shape, ratio);
    // The row of beliefs in one row reads best, so that it wins unless another is clearly larger.
    const merit = size.width * (choice === columns ? 1.15 : 1);
    if (!best || merit > best.merit) best = { columns: choice, ...size, merit };
  }
  return best;
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

/** Keeps `panels` fitted within `stage`: `layOut()` after anything that changes how much fits. */
export function createLayout({ stage, field, panels }, places) {
  let shape = null;

  function layOut() {
    if (!shape || stage.clientWidth === 0) return;
    const style = getComputedStyle(stage);
    const gap = parseFloat(getComputedStyle(panels).columnGap);
    const { count, columns } = places();
    const isStacked = style.getPropertyValue("--stacked").trim() === "1";
    const wanted = isStacked ? Number(style.getPropertyValue("--columns")) : columns;
    const room = area({ isStacked, style });
    const caption = parseFloat(style.getPropertyValue("--caption")) * rem();
    const fitted = fit({ area: room, shape, count, columns: wanted, gap, caption, ratio: devicePixelRatio });
    panels.style.setProperty("--panel-width", `${fitted.width}px`);
    panels.style.setProperty("--panel-height", `${fitted.height}px`);
    panels.style.setProperty("--panel-columns", fitted.columns);
    panels.classList.toggle("is-smooth", !fitted.isCrisp);
    panels.classList.toggle("is-regular", fitted.columns === columns);
  }

  // What legends and charts leave.
  function area({ isStacked, style }) {
    if (isStacked) return { width: stage.clientWidth, height: Infinity };
    const others = [...field.children].filter((child) => child !== panels && child.offsetParent);
    const gaps = parseFloat(getComputedStyle(field).rowGap) || 0;
    const used = others.reduce((sum, child) =>
      sum + (getComputedStyle(child).position === "absolute" ? 0 : child.offsetHeight + gaps), 0);
    const chartsWidth = parseFloat(style.getPropertyValue("--charts")) * rem();
    return {
      width: stage.clientWidth - chartsWidth - parseFloat(style.columnGap),
      height: stage.clientHeight - used,
    };
  }

  new ResizeObserver(layOut).observe(stage);
  return {
    layOut,
    shape(next) { shape = next; layOut(); },
  };
}

function rem() {
  return parseFloat(getComputedStyle(document.documentElement).fontSize);
}
