// Axes: where ticks go, and where serials lie across a chart.

/** Ticks at 1, 2 or 5 times a power of ten that cover `low..high`, about `count` of them. */
export function ticks(low, high, count) {
  const step = niceStep((high - low) / count);
  const first = Math.floor(low / step + 1e-9);
  const last = Math.max(Math.ceil(high / step - 1e-9), first + 1);
  const at = [];
  for (let i = first; i <= last; i += 1) at.push(i * step);
  return { at, step };
}

/** A tick as text, with the digits that its step needs. */
export function tickText(value, step) {
  if (Math.abs(value) >= 10000 && step >= 1000) return `${Math.round(value / 100) / 10}k`;
  return value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
}

/** Least and most of the numbers that are not NaN; null if there are none. */
export function extent(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low > high ? null : { low, high };
}

/** How the serials of a series lie across a chart, and which step each is. */
export function across(series) {
  const { first, last, bins } = series;
  const count = last - first + 1;
  // Steps and serials go together, unless episodes ended or frames were lost in between.
  const isPlain = series.last_step - series.first_step === last - first;
  return {
    first,
    last,
    word: isPlain ? "k" : "entry",
    number: (serial) => serial + (isPlain ? series.first_step - first : 0),
    serial: (number) => number - (isPlain ? series.first_step - first : 0),
    share: (serial) => (serial - first + 0.5) / count,
    at: (share) => Math.min(Math.max(Math.floor(first + share * count), first), last),
    bin: (serial) => Math.floor(((serial - first) * bins) / count),
    /** Where a bin lies: with fewer entries than bins, where its entry does. */
    binShare: (bin) => (count < bins ? Math.ceil((bin * count) / bins) + 0.5 : ((bin + 0.5) * count) / bins) / count,
    // With fewer entries than bins there are bins that no entry falls into: no gaps.
    bridge: Math.ceil(bins / count),
  };
}

function niceStep(rough) {
  if (!(rough > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const factor = rough / power;
  return power * (factor <= 1 ? 1 : factor <= 2 ? 2 : factor <= 5 ? 5 : 10);
}
