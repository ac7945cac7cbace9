// A worker that sorts splats from far to near (radix sort of the depths' bits; of equal depths, later rows come first).
"use strict";
let means, keys, rows, other, counts;

onmessage = ({ data }) => {
  if (data.means) {
    means = data.means;
    const n = means.length / 3;
    [keys, rows, other, counts] = [new Float32Array(n), new Uint32Array(n), new Uint32Array(n), new Uint32Array(1 << 16)];
    return;
  }
  const [x, y, z, w] = data.plane; // depth = x X + y Y + z Z + w
  let count = 0;
  for (let i = 0; i < data.limit; ++i) {
    keys[i] = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + w;
    if (keys[i] > data.near) rows[count++] = i;
  }
  const bits = new Uint32Array(keys.buffer); // bits of positive floats have the order of the floats
  let from = rows, to = other;
  for (const shift of [0, 16]) {
    counts.fill(0);
    for (let i = 0; i < count; ++i) counts[(bits[from[i]] >>> shift) & 0xffff]++;
    for (let i = 0, total = 0; i < counts.length; ++i) [counts[i], total] = [total, total + counts[i]];
    for (let i = 0; i < count; ++i) to[counts[(bits[from[i]] >>> shift) & 0xffff]++] = from[i];
    [from, to] = [to, from];
  }
  const order = from.slice(0, count).reverse();
  postMessage({ order, request: data.request }, [order.buffer]);
};
