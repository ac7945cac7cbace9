// A worker: the rows of the splats from far to near, exactly (radix sort of the depths' bits; equal depths: later rows first).
"use strict";
let means, keys, rows, other, counts;

onmessage = ({ data }) => {
  if (data.means) {
    means = data.means;
    const n = means.length / 3;
    keys = new Float32Array(n);
    rows = new Uint32Array(n);
    other = new Uint32Array(n);
    counts = new Uint32Array(1 << 16);
    return;
  }
  const [x, y, z, w] = data.ahead; // depth = x X + y Y + z Z + w
  let count = 0;
  for (let i = 0, n = means.length / 3; i < n; ++i) {
    keys[i] = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + w;
    if (keys[i] > data.near) rows[count++] = i;
  }
  const bits = new Uint32Array(keys.buffer); // of positive floats: in the order of the floats
  let from = rows, to = other;
  for (const down of [0, 16]) {
    counts.fill(0);
    for (let i = 0; i < count; ++i) counts[(bits[from[i]] >>> down) & 0xffff]++;
    for (let i = 0, total = 0; i < counts.length; ++i) {
      const here = counts[i];
      counts[i] = total;
      total += here;
    }
    for (let i = 0; i < count; ++i) to[counts[(bits[from[i]] >>> down) & 0xffff]++] = from[i];
    [from, to] = [to, from];
  }
  const order = from.slice(0, count).reverse();
  postMessage({ order, number: data.number }, [order.buffer]);
};
