// Shows points and meshes, of one building at a time or of a scene. Reads its data from #viewer-data and draws only on
// changes. A building of a scene can be clicked, in the picture or in the table, or be searched.
"use strict";
(() => {
  const root = document.getElementById("viewer");
  const data = JSON.parse(document.getElementById("viewer-data").textContent);
  const canvas = root.querySelector("canvas");
  const select = root.querySelector("select.building");
  const paints = root.querySelector("select.paint");
  const layers = root.querySelector(".layers");
  const facts = root.querySelector(".facts");
  const together = data.together;
  // from 0 to REACH metres
  const RAMP = ["#4f9bd9", "#f2e279", "#f39c34", "#d7301f", "#7a0403"];
  const REACH = 1;
  // with more buildings, points would hide them
  const MAX_WITH_POINTS = 100;
  // what the points say of a mesh; residuals of meshes are means and reach less far than those of points
  const STATES = {
    ok: ["#7fa88b", "reconstructed"],
    flagged: ["#d98e04", "to be checked"],
    flat: ["#7b5ea7", "flat roof instead"],
    none: ["#9aa4ab", "no mesh"],
  };
  const MESH_REACH = 0.5;
  const CHOSEN = "#1f6fd1";
  const UNKNOWN = STATES.none[0];
  const PALETTE = ["#2a6f97", "#c8603a", "#7fa88b", "#b8a13c", "#7b5ea7", "#d98e04", "#5b8c85", "#a04668"];
  const UNITS = { m: "m", m2: "m²", m3: "m³", deg: "°" };

  function decoded(text, Kind) {
    const characters = atob(text);
    const bytes = new Uint8Array(characters.length);
    for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
    return new Kind(bytes.buffer);
  }

  // no conversion of colours: the same as in the page's other pictures
  THREE.ColorManagement.enabled = false;
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  } catch {
    root.classList.add("failed");
  }
  const scene = new THREE.Scene();
  scene.add(new THREE.HemisphereLight("#ffffff", "#9aa4ab", 2.2));
  const sun = new THREE.DirectionalLight("#ffffff", 1.6);
  sun.position.set(-0.35, -0.6, 0.72);
  scene.add(sun);
  const camera = new THREE.PerspectiveCamera(35, 1, 0.1, 5000);
  camera.up.set(0, 0, 1);
  const draw = () => {
    renderer?.render(scene, camera);
    if (together && renderer) annotate();
  };
  let controls = null;
  if (renderer) {
    renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    controls = new THREE.OrbitControls(camera, canvas);
    controls.maxPolarAngle = 0.55 * Math.PI;
    controls.addEventListener("change", draw);
    const context = renderer.getContext();
    const about = context.getExtension("WEBGL_debug_renderer_info");
    if (about && /swiftshader|llvmpipe|software|basic render/i.test(context.getParameter(about.UNMASKED_RENDERER_WEBGL))) {
      // without a graphics card the picture would not follow the pointer
      const show = (are) => () => {
        const others = parts.getObjectByName("others");
        if (others) others.visible = are && visible.others;
      };
      controls.addEventListener("start", show(false));
      controls.addEventListener("end", () => (show(true)(), draw()));
    }
  }

  const stops = RAMP.map((color) => new THREE.Color(color));
  function ramp(share) {
    const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    return stops[low].clone().lerp(stops[low + 1], at - low);
  }
  const steps = Array.from({ length: 256 }, (_, i) => ramp(i / 255));

  const visible = { points: !together || data.buildings.length <= MAX_WITH_POINTS };
  for (const around of data.around) visible[around.key] = true;
  for (const method of data.methods) {
    visible[method.key] = method.shown;
    if (method.ours && data.methods.length > 1) root.querySelector(".ours").textContent = `the mesh of ${method.name}`;
  }
  let parts = new THREE.Group();
  let shown = [];
  let chosen = -1;
  let painted = null;

  function pointsOf(buildings) {
    const chunks = buildings.map((building) => ({
      place: building.place,
      xyz: decoded(building.points, Int16Array),
      distance: decoded(building.distances, Uint8Array),
    }));
    const number = chunks.reduce((sum, chunk) => sum + chunk.distance.length, 0);
    const place = new Float32Array(3 * number);
    const color = new Float32Array(3 * number);
    let at = 0;
    for (const chunk of chunks) {
      chunk.distance.forEach((step, i) => {
        for (let k = 0; k < 3; k++) place[at + k] = chunk.place[k] + chunk.xyz[3 * i + k] / 100;
        steps[step].toArray(color, at);
        at += 3;
      });
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(place, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(color, 3));
    const size = (together ? 1.3 : 2.5) * renderer.getPixelRatio();
    const material = new THREE.PointsMaterial({ size, sizeAttenuation: false });
    material.vertexColors = true;
    return new THREE.Points(geometry, material);
  }

  // in one colour and without edges, so that triangles can share vertices
  function shapesOf(mesh) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(decoded(mesh.vertices, Int32Array)), 3));
    geometry.setIndex(new THREE.BufferAttribute(decoded(mesh.triangles, Uint32Array), 1));
    const shapes = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color: mesh.color, flatShading: true }));
    shapes.scale.setScalar(0.001); // of millimetres
    return shapes;
  }

  function meshOf(members, method) {
    const places = [];
    const kinds = [];
    const owners = [];
    for (const [index, mesh] of members) {
      const vertex = decoded(mesh.vertices, Int32Array);
      const kind = decoded(mesh.kinds, Uint8Array);
      decoded(mesh.triangles, Uint32Array).forEach((v) => {
        for (let k = 0; k < 3; k++) places.push(vertex[3 * v + k] / 1000);
      });
      kind.forEach((each) => (kinds.push(each), owners.push(index)));
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(places), 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(places.length), 3));
    geometry.computeVertexNormals();
    const material = new THREE.MeshLambertMaterial({ vertexColors: true, flatShading: true, side: THREE.DoubleSide });
    // the edges lie in the faces and must be drawn over them
    Object.assign(material, { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
    const isGround = method.key === "ground";
    if (isGround) Object.assign(material, { polygonOffsetFactor: 2, polygonOffsetUnits: 200 });
    if (!method.ours && !isGround) {
      // behind our mesh where both lie in one plane
      Object.assign(material, { transparent: true, opacity: 0.55, depthWrite: false, polygonOffsetFactor: 2 });
    }
    const group = new THREE.Group();
    const faces = new THREE.Mesh(geometry, material);
    faces.userData = { kinds, owners, method };
    group.add(faces);
    if (!isGround) {
      const line = new THREE.LineBasicMaterial({ color: method.ours ? "#222222" : method.color });
      group.add(new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 1), line));
    }
    paint(faces);
    return group;
  }

  function colorOf(kind, owner, method) {
    if (owner === chosen) return new THREE.Color(CHOSEN);
    if (!method.ours) return new THREE.Color(method.color);
    return (coloring?.of ?? PAINTS.kind.of)(data.buildings[owner], kind);
  }

  // colours of meshes by what is known of buildings: of(building, kind of the face) and the items of the legend; none
  // where nothing is known

  const gradient = `linear-gradient(90deg, ${RAMP.join(", ")})`;
  const words = (code) => String(code).replaceAll("-", " ");
  const byKind = { title: "walls and roofs", of: (_, kind) => new THREE.Color(data.kinds[kind]), legend: [] };

  function byNumber(title, value, reach) {
    const known = data.buildings.map(value).filter(Number.isFinite).sort((a, b) => a - b);
    if (!known.length) return null;
    // most of them
    const high = (reach ?? known[Math.floor(0.95 * (known.length - 1))]) || 1;
    const of = (building) => (Number.isFinite(value(building)) ? ramp(value(building) / high) : new THREE.Color(UNKNOWN));
    return { title, of, legend: [[gradient, `0 to ${high.toFixed(1)} m and more`]] };
  }

  function byName(title, value, colors) {
    const counts = new Map();
    for (const name of data.buildings.flatMap((building) => value(building))) if (name) counts.set(name, (counts.get(name) ?? 0) + 1);
    if (!counts.size) return null;
    const names = [...counts.keys()].sort((a, b) => counts.get(b) - counts.get(a));
    const color = (name) => colors?.[name] ?? PALETTE[names.indexOf(name)] ?? UNKNOWN;
    const legend = names.slice(0, PALETTE.length).map((name) => [color(name), `${words(name)} (${counts.get(name)})`]);
    const of = (building, kind) => new THREE.Color(color(value(building, kind)[0]));
    return { title, of, legend };
  }

  const materialsOf = ({ materials }, kind) =>
    kind === undefined ? Object.values(materials) : [materials[data.surfaces[kind]]];
  const stateColors = Object.fromEntries(Object.values(STATES).map(([color, text]) => [text, color]));
  const PAINTS = {
    kind: byKind,
    state: byName("what to check", ({ state }) => [STATES[state][1]], stateColors),
    residual: byNumber("distance to the points", ({ residual }) => residual ?? NaN, MESH_REACH),
    height: byNumber("height", ({ height }) => height ?? NaN),
    roof: byName("type of roof", ({ attributes }) => [attributes.roof_type]),
    reason: byName("reason", ({ attributes }) => [attributes.reason ?? attributes.footprint_flags]),
    material: byName("material", materialsOf, data.materials),
  };
  let coloring = null;

  function paint(faces) {
    const { kinds, owners, method } = faces.userData;
    const color = faces.geometry.getAttribute("color");
    kinds.forEach((kind, i) => {
      const value = colorOf(kind, owners[i], method);
      for (let k = 0; k < 3; k++) value.toArray(color.array, 9 * i + 3 * k);
    });
    color.needsUpdate = true;
    if (method.ours) painted = faces;
  }

  function clear(group) {
    group.traverse((part) => {
      part.geometry?.dispose();
      part.material?.dispose();
    });
    scene.remove(group);
  }

  function boundsOf(indices) {
    const all = indices.map((index) => data.buildings[index].bounds);
    const low = all[0][0].map((_, k) => Math.min(...all.map((bounds) => bounds[0][k])));
    const high = all[0][1].map((_, k) => Math.max(...all.map((bounds) => bounds[1][k])));
    return [low, high];
  }

  function aim(indices) {
    const [low, high] = boundsOf(indices);
    const middle = new THREE.Vector3(...low.map((value, i) => (value + high[i]) / 2));
    const radius = Math.max(Math.hypot(...low.map((value, i) => high[i] - value)) / 2, 1);
    const eye = new THREE.Vector3(-0.49, -0.69, 0.53).normalize();
    const right = new THREE.Vector3(0.69, -0.49, 0).normalize();
    const above = eye.clone().cross(right);
    // the boxes of all buildings fit into the picture, in whose middle they are
    const half = Math.tan(((camera.fov / 2) * Math.PI) / 180);
    const corners = indices.flatMap((index) => {
      const [from, to] = data.buildings[index].bounds;
      return [0, 1, 2, 3, 4, 5, 6, 7].map((k) => new THREE.Vector3(...from.map((value, i) => ((k >> i) & 1 ? to[i] : value))));
    });
    let reach = radius;
    for (let round = 0; round < 4; round++) {
      const seen = corners.map((corner) => corner.clone().sub(middle)).map((v) => [v.dot(right), v.dot(above), v.dot(eye)]);
      reach = Math.max(1, ...seen.map(([x, y, z]) => z + Math.max(Math.abs(x) / camera.aspect, Math.abs(y)) / half));
      for (const [axis, k] of [[right, 0], [above, 1]]) {
        const places = seen.map((v) => v[k] / (reach - v[2]));
        middle.addScaledVector(axis, ((Math.min(...places) + Math.max(...places)) / 2) * reach);
      }
    }
    reach *= indices.length > 1 ? 1.06 : 1.8;
    camera.position.copy(middle).addScaledVector(eye, reach);
    camera.near = reach / 100;
    camera.far = reach * 20;
    camera.updateProjectionMatrix();
    controls.target.copy(middle);
    controls.update();
    draw();
  }

  // the camera around its target: radians to the right and upwards
  function turn(right, up) {
    const { x, y, z } = camera.position.clone().sub(controls.target);
    const flat = Math.hypot(x, y);
    const around = Math.atan2(y, x) - right;
    const height = Math.min(Math.max(Math.atan2(z, flat) + up, -0.1), 1.55);
    const reach = Math.hypot(flat, z);
    const place = [Math.cos(around) * Math.cos(height), Math.sin(around) * Math.cos(height), Math.sin(height)];
    camera.position.copy(controls.target).addScaledVector(new THREE.Vector3(...place), reach);
  }

  // the bar of length, which holds in the middle of the picture, and where north is
  function annotate() {
    const [bar, label] = root.querySelector(".scale").children;
    const ahead = controls.target.clone().sub(camera.position);
    const perPixel = (2 * ahead.length() * Math.tan((camera.fov * Math.PI) / 360)) / Math.max(canvas.clientHeight, 1);
    const power = 10 ** Math.floor(Math.log10(120 * perPixel));
    const length = [5, 2, 1].map((each) => each * power).find((each) => each <= 120 * perPixel) ?? power;
    bar.style.width = `${length / perPixel}px`;
    label.textContent = length < 1000 ? `${Number(length.toPrecision(1))} m` : `${length / 1000} km`;
    root.querySelector(".north").style.transform = `rotate(${-Math.atan2(ahead.x, ahead.y)}rad)`;
  }

  function dress(isDark) {
    renderer?.setClearColor(isDark ? "#14181c" : "#eef1f3");
    const ground = data.around.find(({ key }) => key === "ground");
    if (ground) ground.color = isDark ? "#4a524c" : ground.light ?? (ground.light = ground.color);
    parts.traverse((part) => part.userData.method === ground && ground && paint(part));
  }

  function toggle(key, label, color) {
    const box = document.createElement("input");
    box.type = "checkbox";
    box.name = key;
    box.checked = visible[key];
    box.disabled = !parts.getObjectByName(key);
    box.addEventListener("change", () => {
      visible[key] = box.checked;
      parts.getObjectByName(key).visible = box.checked;
      draw();
    });
    const whole = document.createElement("label");
    whole.append(box, swatch(color), label);
    return whole;
  }

  function swatch(color) {
    const result = document.createElement("i");
    result.style.background = color;
    return result;
  }

  function show(indices) {
    shown = indices;
    const buildings = indices.map((index) => data.buildings[index]);
    clear(parts);
    parts = new THREE.Group();
    const add = (part, key) => {
      part.name = key;
      part.visible = visible[key];
      parts.add(part);
    };
    add(pointsOf(buildings), "points");
    const descriptions = [];
    for (const method of data.methods) {
      const members = indices.map((index) => [index, data.buildings[index].meshes[method.key]]);
      const meshes = members.filter(([, mesh]) => mesh);
      if (meshes.length) add(meshOf(meshes, method), method.key);
      const all = together ? `${meshes.length} meshes` : meshes.length ? meshes[0][1].facts : "no mesh";
      descriptions.push(`${method.name}: ${all}`);
    }
    // not of a building
    for (const around of data.around) add(around.key === "others" ? shapesOf(around) : meshOf([[null, around]], around), around.key);
    scene.add(parts);
    layers.replaceChildren(
      toggle("points", `Points: 0 to ${REACH} m from the mesh`, gradient),
      ...[...data.methods, ...data.around].map(({ key, name, color }) => toggle(key, name, color)),
    );
    const about = together ? `${indices.length} buildings` : buildings[0].about;
    facts.textContent = `${about}. ${descriptions.join("; ")}.${data.crs ? ` Coordinates: ${data.crs}.` : ""}`;
    canvas.dataset.building = together ? "" : buildings[0].id;
    canvas.setAttribute("aria-label", together ? "3D view of all buildings" : `3D view of building ${buildings[0].id}`);
    aim(indices);
  }

  // a scene: one building chosen of all, with its attributes, and a table of all

  const panel = root.querySelector(".attributes");
  const rows = [];

  function choose(index, follow) {
    rows[chosen]?.classList.remove("chosen");
    chosen = index;
    rows[chosen]?.classList.add("chosen");
    canvas.dataset.building = chosen < 0 ? "" : data.buildings[chosen].id;
    panel.replaceChildren();
    if (chosen >= 0) {
      const building = data.buildings[chosen];
      const title = document.createElement("h3");
      title.textContent = building.id;
      const inputs = building.inputs.map((name) => [name, building.attributes[name]]);
      const results = Object.entries(building.attributes).filter(([name]) => !building.inputs.includes(name));
      panel.append(title, listed(results));
      if (inputs.length) {
        const heading = document.createElement("h4");
        heading.textContent = "From the footprints";
        panel.append(heading, listed(inputs, true));
      }
    }
    if (!renderer) return;
    parts.traverse((part) => part.userData.owners && paint(part));
    if (follow && chosen >= 0) aim([chosen]);
    draw();
  }

  function listed(attributes, areInputs = false) {
    const list = document.createElement("dl");
    for (const [name, value] of attributes) {
      if (value === null || value === "") continue;
      const [, plain, suffix] = name.match(/^(.*)_(m|m2|m3|deg)$/) ?? [null, name, ""];
      const term = document.createElement("dt");
      const content = document.createElement("dd");
      term.textContent = areInputs ? name : plain.replaceAll("_", " ");
      term.title = name;
      content.textContent = typeof value === "number" && !areInputs && UNITS[suffix] ? `${rounded(value)} ${UNITS[suffix]}` : told(value);
      list.append(term, content);
    }
    return list;
  }

  const rounded = (value) =>
    Number.isInteger(value) ? String(value) : value.toFixed(Math.abs(value) < 1 ? 3 : Math.abs(value) < 100 ? 2 : 1);

  function told(value) {
    if (typeof value === "number") return rounded(value);
    if (typeof value === "boolean") return value ? "yes" : "no";
    if (typeof value === "object") return JSON.stringify(value);
    const codes = String(value).split(" ");
    if (!codes.every((code) => code !== "ok" && Object.hasOwn(data.meanings, code))) return String(value);
    return codes.map((code) => `${words(code)}: ${data.meanings[code]}`).join("; ");
  }

  function picked(event) {
    const box = canvas.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * 2 - 1;
    const y = 1 - ((event.clientY - box.top) / box.height) * 2;
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2(x, y), camera);
    const faces = [];
    parts.traverse((part) => part.userData.owners && part.parent.visible && faces.push(part));
    const owners = ray.intersectObjects(faces, false).map((hit) => hit.object.userData.owners[hit.faceIndex]);
    return owners.find((owner) => owner !== null) ?? -1;
  }

  function table(body, heads) {
    const names = heads.map((head) => head.dataset.name);
    data.buildings.forEach((building, index) => {
      const row = body.insertRow();
      row.tabIndex = 0;
      for (const name of names) {
        const value = name === "id" ? building.id : name === "state" ? STATES[building.state][1] : building.attributes[name];
        const cell = row.insertCell();
        if (name === "state") cell.append(swatch(STATES[building.state][0]));
        const isNumber = typeof value === "number";
        const isCode = name === "reason" || name === "footprint_flags" || name === "roof_type";
        cell.append(isNumber && !Number.isInteger(value) ? value.toFixed(3) : isCode && value ? words(value) : (value ?? "–"));
        if (isCode && value) cell.title = told(value);
        if (!isNumber) cell.className = "text";
      }
      row.addEventListener("click", () => choose(index, true));
      row.addEventListener("keydown", (event) => event.key === "Enter" && choose(index, true));
      rows.push(row);
    });
    heads.forEach((head, column) => {
      head.addEventListener("click", () => {
        const down = head.ariaSort !== "descending";
        for (const other of heads) other.ariaSort = null;
        head.ariaSort = down ? "descending" : "ascending";
        const value = (row) => row.cells[column].textContent;
        const number = (row) => Number.parseFloat(value(row));
        const order = (a, b) => number(a) - number(b) || value(a).localeCompare(value(b));
        body.append(...[...rows].sort((a, b) => (down ? -order(a, b) : order(a, b))));
      });
    });
  }

  if (together) {
    const body = document.querySelector(".buildings tbody");
    table(body, [...document.querySelectorAll(".buildings thead th")]);
    const legend = root.querySelector(".legend");
    for (const [key, paint] of Object.entries(PAINTS)) if (paint) paints.append(new Option(paint.title, key));
    const explain = () => {
      coloring = PAINTS[paints.value];
      legend.replaceChildren(
        ...coloring.legend.map(([color, text]) => {
          const item = document.createElement("label");
          item.append(swatch(color), text);
          return item;
        }),
      );
    };
    explain();
    paints.addEventListener("change", () => {
      explain();
      if (painted) paint(painted);
      draw();
    });
    const search = root.querySelector(".search");
    const found = () => [...body.rows].filter((row) => !row.hidden);
    search.addEventListener("input", () => {
      const text = search.value.trim().toLowerCase();
      for (const row of rows) row.hidden = !row.textContent.toLowerCase().includes(text);
    });
    search.addEventListener("keydown", (event) => {
      const [first] = found();
      if (event.key === "Enter" && first) choose(rows.indexOf(first), true);
    });
    root.querySelector(".save").addEventListener("click", () => {
      draw(); // a picture is kept until the page is shown again only
      canvas.toBlob((blob) => {
        const link = document.createElement("a");
        link.href = URL.createObjectURL(blob);
        link.download = `${document.title}.png`;
        link.click();
        URL.revokeObjectURL(link.href);
      });
    });
    // the name of the building under the pointer
    const tip = root.querySelector(".tip");
    let pending = 0;
    canvas.addEventListener("pointerleave", () => (tip.hidden = true));
    canvas.addEventListener("pointermove", (event) => {
      tip.hidden = true;
      if (event.buttons || event.pointerType === "touch") return;
      cancelAnimationFrame(pending);
      pending = requestAnimationFrame(() => {
        const index = picked(event);
        if (index < 0) return;
        tip.textContent = data.buildings[index].id;
        tip.style.left = `${event.offsetX + 14}px`;
        tip.style.top = `${event.offsetY + 10}px`;
        tip.hidden = false;
      });
    });
    canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
      const zooms = { "+": 0.85, "=": 0.85, "-": 1 / 0.85 };
      if (turns[event.key]) turn(...turns[event.key].map((step) => step * 0.09));
      else if (zooms[event.key]) camera.position.sub(controls.target).multiplyScalar(zooms[event.key]).add(controls.target);
      else if (event.key === "Escape") choose(-1, false);
      else if (event.key === "Home") aim(shown);
      else return;
      event.preventDefault();
      controls.update();
      draw();
    });
    const night = window.matchMedia("(prefers-color-scheme: dark)");
    night.addEventListener("change", () => (dress(night.matches), draw()));
    let down = null;
    canvas.addEventListener("pointerdown", (event) => (down = [event.clientX, event.clientY]));
    canvas.addEventListener("pointerup", (event) => {
      // not after a drag
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4) choose(picked(event), false);
      down = null;
    });
  } else {
    let group = null;
    data.buildings.forEach((building, index) => {
      if (group?.label !== building.group) {
        group = document.createElement("optgroup");
        group.label = building.group;
        select.append(group);
      }
      group.append(new Option(building.title, index));
    });
    const step = (by) => {
      select.selectedIndex = (select.selectedIndex + by + data.buildings.length) % data.buildings.length;
      show([select.selectedIndex]);
    };
    select.addEventListener("change", () => show([select.selectedIndex]));
    root.querySelector(".previous").addEventListener("click", () => step(-1));
    root.querySelector(".next").addEventListener("click", () => step(1));
  }
  if (!renderer) return;
  dress(together && window.matchMedia("(prefers-color-scheme: dark)").matches);
  root.querySelector(".reset").addEventListener("click", () => aim(shown));
  function fit() {
    const { clientWidth, clientHeight } = canvas;
    const size = renderer.getSize(new THREE.Vector2());
    if (!clientWidth || !clientHeight || (size.x === clientWidth && size.y === clientHeight)) return false;
    renderer.setSize(clientWidth, clientHeight, false);
    camera.aspect = clientWidth / clientHeight;
    camera.updateProjectionMatrix();
    return true;
  }
  // of a large scene, a first picture in another size takes a second
  fit();
  new ResizeObserver(() => fit() && draw()).observe(canvas);
  show(together ? data.buildings.map((_, index) => index) : [0]);
})();
