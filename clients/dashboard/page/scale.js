// Axes: positions of ticks, and positions of serial numbers across a chart.

/** Returns about `count` ticks that cover `low..high`, spaced by 1, 2 or 5 times a power of ten. */
export function ticks(low, high, count) {
  const step = niceStep((high - low) / count);
  const first = Math.floor(low / step + 1e-9);
  const last = Math.max(Math.ceil(high / step - 1e-9), first + 1);
  const at = [];
  for (let i = first; i <= last; i += 1) at.push(i * step);
  return { at, step };
}

export function tickText(value, step) {
  if (Math.abs(value) >= 10000 && step >= 1000) return `${Math.round(value / 100) / 10}k`;
  return value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
}

export function extent(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low > high ? null : { low, high };
}

/** Returns functions that map a series' serial numbers to positions across a chart, and to steps. */
export function across(series) {
  const { first, last, bins } = series;
  const count = last - first + 1;
  // Steps and serials differ by a constant, unless episodes ended or frames were lost in between.
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
    /** Returns a bin's position. If there are fewer entries than bins, returns the position of its entry. */
    binShare: (bin) => (count < bins ? Math.ceil((bin * count) / bins) + 0.5 : ((bin + 0.5) * count) / bins) / count,
    // If there are fewer entries than bins, some bins are empty without being gaps.
    bridge: Math.ceil(bins / count),
  };
}

function niceStep(rough) {
  if (!(rough > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const factor = rough / power;
  return power * (factor <= 1 ? 1 : factor <= 2 ? 2 : factor <= 5 ? 5 : 10);
}
