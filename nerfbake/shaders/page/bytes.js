// Coefficients in eight bits each, for the memory of a phone; densities keep their sixteen. round_to_bytes() of
// nerfbake/stages/page_field_to_field.py rounds the same way.

// Where the k-th coefficient of a colour stands in a row.
function channelOf(k, colour) {
  return k ? 4 + 3 * (k - 1) + colour : colour;
}

// Rows of halves -> {bytes, densities (halves), lows (three a function), widths}: a coefficient is low + width byte / 255.
function* inBytes(texels, T) {
  const channels = 4 * T, rows = texels.length / channels, functions = 1 + (4 * (T - 1)) / 3;
  const bytes = new Uint8Array(texels.length), densities = new Uint16Array(rows);
  const lows = new Float64Array(3 * functions), widths = new Float64Array(functions).fill(1);
  for (let row = 0; row < rows; row++) densities[row] = texels[row * channels + 3];
  for (let k = 0; k < functions; k++) {
    let width = 0;
    for (let colour = 0; colour < 3; colour++) {
      let low = Infinity, high = -Infinity;
      for (let at = channelOf(k, colour); at < texels.length; at += channels) {
        const value = numberOf(texels[at]);
        if (value < low) low = value;
        if (value > high) high = value;
      }
      lows[3 * k + colour] = low;
      width = Math.max(width, high - low);
    }
    widths[k] = width || 1;
    for (let colour = 0; colour < 3; colour++) {
      const low = lows[3 * k + colour];
      for (let at = channelOf(k, colour); at < texels.length; at += channels) {
        bytes[at] = Math.floor(((numberOf(texels[at]) - low) / widths[k]) * 255 + 0.5);
      }
    }
    yield k / functions;
  }
  return { bytes, densities, lows, widths };
}
