// Round coefficients to eight bits each, for the memory of a phone; densities keep 16 bits. round_to_bytes() in
// nerfbake/stages/scene_to_field.py rounds in the same way.

// The channel of a row that contains the k-th coefficient of a colour.
function channelOf(k, colour) {
  return k ? 4 + 3 * (k - 1) + colour : colour;
}

// Rows of halves -> {bytes, densities (halves), lows (three per function), widths}: a coefficient is low + width byte /
// 255.
function* inBytes(texels, T) {
  const channels = 4 * T, rows = texels.length / channels, functions = 1 + (4 * (T - 1)) / 3;
  const bytes = new Uint8Array(texels.length), densities = new Uint16Array(rows);
  const lows = new Float64Array(3 * functions), widths = new Float64Array(functions).fill(1);
  // First the minimum and the maximum of each channel, row by row as in memory; then the lows and the widths.
  const low = new Float64Array(channels).fill(Infinity), high = new Float64Array(channels).fill(-Infinity);
  for (let row = 0, at = 0; row < rows; row++) {
    for (let channel = 0; channel < channels; channel++, at++) {
      const value = numberOf(texels[at]);
      if (value < low[channel]) low[channel] = value;
      if (value > high[channel]) high[channel] = value;
    }
    if (row % 16384 === 0) yield (0.5 * row) / rows;
  }
  const width = new Float64Array(channels);
  for (let k = 0; k < functions; k++) {
    const places = [0, 1, 2].map((colour) => channelOf(k, colour));
    widths[k] = Math.max(...places.map((channel) => high[channel] - low[channel]), 0) || 1;
    places.forEach((channel, colour) => (lows[3 * k + colour] = low[channel]));
    for (const channel of places) width[channel] = widths[k];
  }
  for (let row = 0, at = 0; row < rows; row++) {
    densities[row] = texels[at + 3];
    for (let channel = 0; channel < channels; channel++, at++) {
      if (channel !== 3) bytes[at] = Math.floor(((numberOf(texels[at]) - low[channel]) / width[channel]) * 255 + 0.5);
    }
    if (row % 16384 === 0) yield 0.5 + (0.5 * row) / rows;
  }
  return { bytes, densities, lows, widths };
}
