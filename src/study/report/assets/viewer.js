// The 3-D view: NiiVue draws CT slices and meshes; what is chosen decides which meshes there are and their colours.
"use strict";
(async () => {
  const config = JSON.parse(document.getElementById("study-config").textContent);
  const by = (id) => document.getElementById(id);
  const viewer = by("viewer"), canvas = by("v-canvas"), told = by("v-told");
  // viridis: rising lightness, told apart by colour-blind readers, and unlike the grey of the CT.
  const RAMP = ["440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725"];
  const TOP_MM = 12;  // one scale for every pair and method, so that two views can be compared
  const COLOURS = { us: "56b4e9", source: "8d949e", carried: "d55e00", goal: "ffffff", gct: "cc79a7", gus: "0072b2" };
  const PARTS = ["8c8c8c", "0072b2", "e69f00", "009e73", "cc79a7", "61a8d1", "f0c361", "61c4ab", "e0aecb"];
  const rgb = (hex) => [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16));
  const ramp = RAMP.map(rgb);

  for (const [name, hex] of Object.entries(COLOURS))
    for (const key of document.querySelectorAll(`.key.${name}`)) key.style.background = `#${hex}`;
  by("v-ramp").style.background = `linear-gradient(to right, ${RAMP.map((hex) => `#${hex}`).join(", ")})`;

  function fill(select, items, wanted) {
    select.replaceChildren(...items.map(([value, text]) => new Option(text, value)));
    if (items.some(([value]) => value === wanted)) select.value = wanted;
  }
  const chosenSet = () => config.datasets[by("v-dataset").value];
  const chosenPair = () => chosenSet().pairs[by("v-pair").value];

  function offer() {
    const set = chosenSet();
    fill(by("v-pair"), set.pairs.map((pair, k) => [String(k), pair.label]), "0");
    const first = set.methods.some((m) => m.name === "skeleton_graph") ? "skeleton_graph" : set.methods[0].name;
    fill(by("v-method"), set.methods.map((m) => [m.name, m.label]), by("v-method").value || first);
    fill(by("v-colour"), [
      ...(set.has_truth ? [["true", "true error (mm)"]] : []),
      ["surface", "distance to the US cloud (mm)"], ["part", "part of the chest"]], by("v-colour").value);
    by("v-kind").textContent = set.kind;
  }

  // Meshes. Each is {vertices, faces, colours}: Float32Array (3n), Int32Array (3f), Uint8Array (4n).
  const OCTAHEDRON = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];
  const SIDES = [0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5];

  function joined(meshes) {
    const sum = (name) => meshes.reduce((n, mesh) => n + mesh[name].length, 0);
    const all = { vertices: new Float32Array(sum("vertices")), faces: new Int32Array(sum("faces")), colours: new Uint8Array(sum("colours")) };
    let v = 0, f = 0;
    for (const mesh of meshes) {
      all.vertices.set(mesh.vertices, 3 * v);
      all.colours.set(mesh.colours, 4 * v);
      for (let k = 0; k < mesh.faces.length; k++) all.faces[f + k] = mesh.faces[k] + v;
      v += mesh.vertices.length / 3;
      f += mesh.faces.length;
    }
    return all;
  }

  function painted(vertices, faces, colour) {
    const colours = new Uint8Array((vertices.length / 3) * 4);
    for (let k = 0; k < colours.length; k += 4) colours.set([...colour, 255], k);
    return { vertices, faces, colours };
  }

  // NiiVue has no point clouds: a small octahedron a point.
  function balls(points, radius, hex) {
    const n = points.length / 3, vertices = new Float32Array(n * 18), faces = new Int32Array(n * 24);
    for (let k = 0; k < n; k++) {
      OCTAHEDRON.forEach((corner, c) => corner.forEach((x, a) => { vertices[18 * k + 3 * c + a] = points[3 * k + a] + radius * x; }));
      SIDES.forEach((side, c) => { faces[24 * k + c] = 6 * k + side; });
    }
    return painted(vertices, faces, rgb(hex));
  }

  // A rod of four sides from each first to each second point.
  function rods(from, to, radius, hex) {
    const vertices = [], faces = [];
    for (let k = 0; k < from.length; k++) {
      const d = from[k].map((x, a) => to[k][a] - x), length = Math.hypot(...d);
      if (!(length > 1e-3)) continue;
      const w = d.map((x) => x / length), least = w.map(Math.abs).indexOf(Math.min(...w.map(Math.abs)));
      const e = [0, 0, 0]; e[least] = 1;
      const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
      let u = cross(w, e); const size = Math.hypot(...u); u = u.map((x) => x / size);
      const v = cross(w, u), start = vertices.length / 3;
      for (const end of [from[k], to[k]])
        for (const [a, b] of [[1, 0], [0, 1], [-1, 0], [0, -1]])
          vertices.push(...end.map((x, i) => x + radius * (a * u[i] + b * v[i])));
      for (let s = 0; s < 4; s++) {
        const n = (s + 1) % 4;
        faces.push(start + s, start + n, start + 4 + n, start + s, start + 4 + n, start + 4 + s);
      }
    }
    return painted(Float32Array.from(vertices), Int32Array.from(faces), rgb(hex));
  }
  const row = (points, k) => [points[3 * k], points[3 * k + 1], points[3 * k + 2]];
  const links = (points, pairs, radius, hex) => rods(pairs.map(([a]) => row(points, a)), pairs.map(([, b]) => row(points, b)), radius, hex);
  const pairsOf = (flat) => Array.from({ length: flat.length / 2 }, (_, k) => [flat[2 * k], flat[2 * k + 1]]);

  function mz3({ vertices, faces, colours }) {
    const n = vertices.length / 3, buffer = new ArrayBuffer(16 + 4 * faces.length + 4 * vertices.length + colours.length);
    const head = new DataView(buffer);
    head.setUint16(0, 23117, true);
    head.setUint16(2, 7, true);  // faces, vertices, colours
    head.setUint32(4, faces.length / 3, true);
    head.setUint32(8, n, true);
    new Int32Array(buffer, 16, faces.length).set(faces);
    new Float32Array(buffer, 16 + 4 * faces.length, vertices.length).set(vertices);
    new Uint8Array(buffer, 16 + 4 * (faces.length + vertices.length)).set(colours);
    return buffer;
  }

  // Values a vertex, mm.
  const plus = (a, b) => a.map((x, k) => x + b[k]);
  const apart = (a, b) => Float32Array.from({ length: a.length / 3 }, (_, k) => Math.hypot(a[3 * k] - b[3 * k], a[3 * k + 1] - b[3 * k + 1], a[3 * k + 2] - b[3 * k + 2]));

  function toNearest(a, b) {
    const out = new Float32Array(a.length / 3);
    for (let k = 0; k < out.length; k++) {
      let best = Infinity;
      for (let j = 0; j < b.length; j += 3) {
        const x = a[3 * k] - b[j], y = a[3 * k + 1] - b[j + 1], z = a[3 * k + 2] - b[j + 2], d = x * x + y * y + z * z;
        if (d < best) best = d;
      }
      out[k] = Math.sqrt(best);
    }
    return out;
  }

  function byValue(values) {
    const colours = new Uint8Array(values.length * 4);
    values.forEach((value, k) => {
      const at = Math.min(Math.max(value / TOP_MM, 0), 1) * (ramp.length - 1), low = Math.min(Math.floor(at), ramp.length - 2);
      colours.set([0, 1, 2].map((c) => Math.round(ramp[low][c] + (at - low) * (ramp[low + 1][c] - ramp[low][c]))), 4 * k);
      colours[4 * k + 3] = 255;
    });
    return colours;
  }

  function byPart(parts) {
    const colours = new Uint8Array(parts.length * 4);
    parts.forEach((part, k) => colours.set([...rgb(PARTS[part] || "c8c8c8"), 255], 4 * k));
    return colours;
  }

  function built(ct, pair, number) {
    const faces = Int32Array.from(ct.arrays.faces), of = (name) => pair.arrays[`${number}.${name}`];
    const warped = plus(of("warped"), ct.arrays.source), how = by("v-colour").value;
    const values = how === "true" ? apart(of("warped"), pair.arrays.true) : how === "surface" ? toNearest(warped, pair.arrays.us) : null;
    const path = of("path"), goal = pair.arrays.goal, k = [...Array(path.length / 3).keys()];
    const graphs = of("g_ct") ? [
      links(of("g_ct"), pairsOf(pair.arrays.edges), 0.35, COLOURS.gct), balls(of("g_ct"), 1.1, COLOURS.gct),
      links(of("g_us"), pairsOf(pair.arrays.edges), 0.35, COLOURS.gus), balls(of("g_us"), 1.1, COLOURS.gus)] : [];
    const meshes = {
      warped: { vertices: warped, faces, colours: values ? byValue(values) : byPart(ct.arrays.parts) },
      us: balls(pair.arrays.us, 0.8, COLOURS.us),
      source: painted(ct.arrays.source, faces, rgb(COLOURS.source)),
      path: joined([
        balls(goal, 2.6, COLOURS.goal), balls(path, 2.6, COLOURS.carried), links(path, ct.path, 0.6, COLOURS.carried),
        links(goal, ct.path, 0.6, COLOURS.goal), rods(k.map((i) => row(path, i)), k.map((i) => row(goal, i)), 0.45, "dc0050")]),
      graph: graphs.length ? joined(graphs) : null,
    };
    return { meshes, values };
  }

  // NiiVue.
  let nv = null;
  if (!document.createElement("canvas").getContext("webgl2") || typeof niivue === "undefined") {
    viewer.dataset.state = "no WebGL 2";
    told.textContent = "This browser has no WebGL 2, which the 3-D view needs; the figures and tables stand without it.";
    offerOnly();
    return;
  }
  function offerOnly() { fill(by("v-dataset"), config.datasets.map((set, k) => [String(k), set.name]), "0"); offer(); }
  nv = new niivue.Niivue({
    backColor: [0.8, 0.82, 0.84, 1], crosshairWidth: 0, show3Dcrosshair: false, isOrientCube: true, dragAndDropEnabled: false,
    loadingText: "", logLevel: "silent", isColorbar: false, meshXRay: 0,
  });
  await nv.attachToCanvas(canvas);
  nv.setRadiologicalConvention(true);
  nv.setSliceType(nv.sliceTypeRender);
  nv.setRenderAzimuthElevation(180, 10);
  nv.setScale(1.15);

  let shown = { ct: null, meshes: {} }, turn = 0;

  function layers() {
    for (const [name, mesh] of Object.entries(shown.meshes)) mesh.visible = by(`l-${name}`).checked;
    if (nv.volumes.length) nv.setOpacity(0, by("l-slices").checked ? 1 : 0);
    [0, 1, 2].forEach((k) => { nv.scene.crosshairPos[k] = by(`s-${k}`).value / 100; });
    nv.drawScene();
  }

  async function showVolume(key, ct) {
    if (shown.ct === key) return;
    for (const volume of [...nv.volumes]) nv.removeVolume(volume);
    const volume = await niivue.NVImage.loadFromUrl({ url: ct.nifti.slice(0), name: "ct.nii.gz", colormap: "gray", cal_min: 0, cal_max: 255 });
    nv.addVolume(volume);
    await nv.setVolumeRenderIllumination(-1);  // slices in place of a rendering
    shown.ct = key;
  }

  function tell(set, pair, method, values, hasGraph) {
    const label = set.methods.find((m) => m.name === method).label, numbers = pair.values[method] || {};
    const parts = Object.entries(numbers).map(([metric, value]) => `${config.titles[metric]} ${value.toFixed(1)} mm`);
    let text = `${pair.label}, ${label}: ${parts.join(", ") || "no numbers"}.`;
    if (values) {
      const sorted = Float32Array.from(values).sort();
      const mean = sorted.reduce((a, b) => a + b, 0) / sorted.length;
      text += ` Of the surface drawn: mean ${mean.toFixed(1)}, largest ${sorted[sorted.length - 1].toFixed(1)} mm.`;
    }
    told.textContent = text + (hasGraph ? "" : " This method has no skeleton graph.");
  }

  async function show() {
    const mine = ++turn, set = chosenSet(), pair = chosenPair(), method = by("v-method").value;
    viewer.dataset.state = "loading";
    try {
      const [ct, content] = await Promise.all([study.load(pair.ct), study.load(pair.pair)]);
      if (mine !== turn) return;
      const number = content.methods.indexOf(method);
      for (const mesh of Object.values(shown.meshes)) mesh.unloadMesh(nv.gl);
      nv.meshes = [];  // removeMesh and addMesh would draw the scene once each
      shown.meshes = {};
      await showVolume(pair.ct.key, ct);
      if (mine !== turn) return;
      if (number < 0) {
        told.textContent = `${pair.label}: this method gave no result.`;
        viewer.dataset.state = "no result";
        nv.drawScene();
        return;
      }
      const { meshes, values } = built(ct, content, number);
      for (const [name, mesh] of Object.entries(meshes)) {
        if (!mesh) continue;
        const made = await niivue.NVMesh.readMesh(mz3(mesh), `${name}.mz3`, nv.gl, 1, new Uint8Array([255, 255, 255, 255]), true);
        made.meshShaderIndex = nv.meshShaderNameToNumber("Matte");  // no highlights: colours are read off the bar
        shown.meshes[name] = made;
      }
      if (mine !== turn) return;
      nv.meshes = Object.values(shown.meshes);
      by("l-graph").disabled = !meshes.graph;
      by("v-goal").textContent = content.goal;
      by("v-bar").hidden = !values;
      by("v-bar-title").textContent = by("v-colour").selectedOptions[0].textContent;
      by("v-bar-low").textContent = "0";
      by("v-bar-high").textContent = `${TOP_MM} or more`;
      layers();
      tell(set, pair, method, values, Boolean(meshes.graph));
      viewer.dataset.shown = `${pair.pair.key}/${method}/${by("v-colour").value}`;
      viewer.dataset.state = "ready";
    } catch (error) {
      if (mine !== turn) return;
      viewer.dataset.state = "failed";
      told.textContent = `This pair cannot be drawn: ${error.message}.`;
    }
  }

  offerOnly();
  by("v-dataset").addEventListener("change", () => { offer(); show(); });
  for (const id of ["v-pair", "v-method", "v-colour"]) by(id).addEventListener("change", show);
  for (const name of ["warped", "us", "source", "slices", "path", "graph"]) by(`l-${name}`).addEventListener("change", layers);
  for (const k of [0, 1, 2]) by(`s-${k}`).addEventListener("input", layers);
  for (const button of document.querySelectorAll("[data-look]"))
    button.addEventListener("click", () => nv.setRenderAzimuthElevation(...button.dataset.look.split(",").map(Number)));
  const STEPS = { ArrowLeft: [-10, 0], ArrowRight: [10, 0], ArrowUp: [0, 10], ArrowDown: [0, -10] };
  canvas.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (!step) return;
    event.preventDefault();
    nv.setRenderAzimuthElevation(nv.scene.renderAzimuth + step[0], nv.scene.renderElevation + step[1]);
  });
  // A page that is read from its top loads no data before the view comes near.
  new IntersectionObserver((seen, watcher) => {
    if (!seen.some((one) => one.isIntersecting)) return;
    watcher.disconnect();
    show();
  }, { rootMargin: "300px" }).observe(viewer);
})();
