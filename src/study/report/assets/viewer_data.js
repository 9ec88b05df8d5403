// Files of the 3-D view: loaded by a script element when they are first asked for, unpacked once, kept.
"use strict";
const study = (() => {
  const waiting = new Map(), kept = new Map();

  function bytesOf(text) {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let k = 0; k < raw.length; k++) bytes[k] = raw.charCodeAt(k);
    return bytes;
  }

  async function unzipped(bytes) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).arrayBuffer();
  }

  const TYPES = { i2: Int16Array, u2: Uint16Array, i1: Int8Array };

  async function unpacked(content) {
    const buffer = await unzipped(bytesOf(content.blob)), arrays = {};
    for (const [name, at] of Object.entries(content.table)) {
      const values = new TYPES[at.type](buffer, at.at, at.n);
      arrays[name] = at.step ? Float32Array.from(values, (v, k) => at.origin[k % 3] + at.step * v) : values;
    }
    return { ...content, blob: null, arrays, nifti: content.nifti ? bytesOf(content.nifti).buffer : null };
  }

  // What a file of the report calls.
  function take(key, content) {
    const call = waiting.get(key);
    if (call) call(unpacked(content));
  }

  // The content of a file {key, file}; the most recent ones are kept.
  function load({ key, file }) {
    if (!kept.has(key)) {
      const content = new Promise((done, failed) => {
        waiting.set(key, done);
        const script = document.createElement("script");
        script.src = file;
        script.onerror = () => failed(new Error(`${file} is not in the report's folder`));
        script.onload = () => script.remove();
        document.head.append(script);
      });
      kept.set(key, content);
      content.catch(() => kept.delete(key));
      if (kept.size > 8) kept.delete(kept.keys().next().value);
    }
    return kept.get(key);
  }
  return { take, load };
})();
