// Shows points and meshes, of one building at a time or of a scene. Reads its data from #viewer-data and draws only on
// changes. A building of a scene can be clicked, in the picture or in the table.
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
  const RAMP = ["#30123b", "#28bceb", "#a4fc3c", "#fb7e21", "#7a0403"];
  const REACH = 1;
  // what the points say of a mesh; residuals of meshes are means and reach less far than those of points
  const STATES = {
    ok: ["#7fa88b", "reconstructed"],
    flagged: ["#d98e04", "to be checked"],
    flat: ["#7b5ea7", "flat roof instead"],
    none: ["#9aa4ab", "no mesh"],
  };
  const MESH_REACH = 0.5;
  const CHOSEN = "#1f6fd1";

  const decoded = (text, Kind) => new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

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
  const draw = () => renderer?.render(scene, camera);
  let controls = null;
  if (renderer) {
    renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    renderer.setClearColor("#eef1f3");
    controls = new THREE.OrbitControls(camera, canvas);
    controls.maxPolarAngle = 0.55 * Math.PI;
    controls.addEventListener("change", draw);
  }

  const stops = RAMP.map((color) => new THREE.Color(color));
  function ramp(share) {
    const at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    return stops[low].clone().lerp(stops[low + 1], at - low);
  }
  const steps = Array.from({ length: 256 }, (_, i) => ramp(i / 255));

  const visible = { points: true, plants: true };
  for (const method of data.methods) {
    visible[method.key] = method.ours;
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
    const size = (together ? 1.6 : 2.5) * renderer.getPixelRatio();
    const material = new THREE.PointsMaterial({ size, sizeAttenuation: false });
    material.vertexColors = true;
    return new THREE.Points(geometry, material);
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
    if (!method.ours) {
      // behind our mesh where both lie in one plane
      Object.assign(material, { transparent: true, opacity: 0.55, depthWrite: false, polygonOffsetFactor: 2 });
    }
    const group = new THREE.Group();
    const faces = new THREE.Mesh(geometry, material);
    faces.userData = { kinds, owners, method };
    group.add(faces);
    const line = new THREE.LineBasicMaterial({ color: method.ours ? "#222222" : method.color });
    group.add(new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 1), line));
    paint(faces);
    return group;
  }

  function colorOf(kind, owner, method) {
    if (owner === chosen) return new THREE.Color(CHOSEN);
    if (!method.ours) return new THREE.Color(method.color);
    const building = data.buildings[owner];
    if (paints?.value === "residual") {
      return building.residual === null ? new THREE.Color(STATES.none[0]) : ramp(building.residual / MESH_REACH);
    }
    if (paints?.value === "state") return new THREE.Color(STATES[building.state][0]);
    return new THREE.Color(data.kinds[kind]);
  }

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
    // the bounding sphere fits into the narrower side of the picture
    const half = ((camera.fov / 2) * Math.PI) / 180;
    const reach = radius / Math.sin(Math.min(half, Math.atan(Math.tan(half) * camera.aspect)));
    // a building does not fill its bounding sphere, and a town is flat
    const eye = new THREE.Vector3(-0.49, -0.69, 0.53).setLength((indices.length > 1 ? 0.78 : 0.9) * reach);
    camera.position.copy(middle).add(eye);
    camera.near = reach / 100;
    camera.far = reach * 20;
    camera.updateProjectionMatrix();
    controls.target.copy(middle);
    controls.update();
    draw();
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
    if (data.plants) add(meshOf([[null, data.plants]], data.plants), data.plants.key);
    scene.add(parts);
    const gradient = `linear-gradient(90deg, ${RAMP.join(", ")})`;
    layers.replaceChildren(
      toggle("points", `Points: 0 to ${REACH} m from the mesh`, gradient),
      ...[...data.methods, data.plants].filter(Boolean).map(({ key, name, color }) => toggle(key, name, color)),
    );
    const about = together ? `${indices.length} buildings` : buildings[0].about;
    facts.textContent = `${about}. ${descriptions.join("; ")}.`;
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
      const list = document.createElement("dl");
      for (const [name, value] of Object.entries(building.attributes)) {
        if (value === null || value === "") continue;
        const term = document.createElement("dt");
        const content = document.createElement("dd");
        term.textContent = name;
        content.textContent = typeof value === "object" ? JSON.stringify(value) : String(value);
        list.append(term, content);
      }
      panel.append(title, list);
    }
    if (!renderer) return;
    parts.traverse((part) => part.userData.owners && paint(part));
    if (follow && chosen >= 0) aim([chosen]);
    draw();
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
        cell.append(isNumber && !Number.isInteger(value) ? value.toFixed(3) : (value ?? "–"));
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
    const explain = () => {
      const items = {
        kind: [],
        residual: [[`linear-gradient(90deg, ${RAMP.join(", ")})`, `mean distance of the points, 0 to ${MESH_REACH} m`]],
        state: Object.values(STATES),
      }[paints.value];
      legend.replaceChildren(
        ...items.map(([color, text]) => {
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
  root.querySelector(".reset").addEventListener("click", () => aim(shown));
  new ResizeObserver(() => {
    const { clientWidth, clientHeight } = canvas;
    if (!clientWidth || !clientHeight) return;
    renderer.setSize(clientWidth, clientHeight, false);
    camera.aspect = clientWidth / clientHeight;
    camera.updateProjectionMatrix();
    draw();
  }).observe(canvas);
  camera.aspect = canvas.clientWidth / canvas.clientHeight || 1;
  show(together ? data.buildings.map((_, index) => index) : [0]);
})();
