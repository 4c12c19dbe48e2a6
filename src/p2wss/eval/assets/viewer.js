// Shows points and meshes of one building at a time. Reads its data from #viewer-data and draws only on changes.
"use strict";
(() => {
  const root = document.getElementById("viewer");
  const data = JSON.parse(document.getElementById("viewer-data").textContent);
  const canvas = root.querySelector("canvas");
  const select = root.querySelector("select");
  const layers = root.querySelector(".layers");
  const facts = root.querySelector(".facts");

  const decoded = (text, Kind) => new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

  // no conversion of colours: the same as in the page's other pictures
  THREE.ColorManagement.enabled = false;
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  } catch {
    root.classList.add("failed");
    return;
  }
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  renderer.setClearColor("#eef1f3");
  const scene = new THREE.Scene();
  scene.add(new THREE.HemisphereLight("#ffffff", "#9aa4ab", 2.2));
  const sun = new THREE.DirectionalLight("#ffffff", 1.6);
  sun.position.set(-0.35, -0.6, 0.72);
  scene.add(sun);
  const camera = new THREE.PerspectiveCamera(35, 1, 0.1, 5000);
  camera.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(camera, canvas);
  controls.maxPolarAngle = 0.55 * Math.PI;
  const draw = () => renderer.render(scene, camera);
  controls.addEventListener("change", draw);

  const palette = decoded(data.palette, Uint8Array);
  const visible = { points: true };
  for (const method of data.methods) {
    visible[method.key] = method.ours;
    if (method.ours) root.querySelector(".ours").textContent = `the mesh of ${method.name}`;
  }
  let parts = new THREE.Group();
  let current = null;

  function pointsOf(building) {
    const place = Float32Array.from(decoded(building.points, Int16Array), (cm) => cm / 100);
    const distance = decoded(building.distances, Uint8Array);
    const color = new Float32Array(place.length);
    distance.forEach((step, i) => {
      for (let k = 0; k < 3; k++) color[3 * i + k] = palette[3 * step + k] / 255;
    });
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(place, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(color, 3));
    const material = new THREE.PointsMaterial({ size: 2.5 * renderer.getPixelRatio(), sizeAttenuation: false });
    material.vertexColors = true;
    return new THREE.Points(geometry, material);
  }

  function meshOf(mesh, method) {
    const vertex = Float32Array.from(decoded(mesh.vertices, Int32Array), (mm) => mm / 1000);
    const corner = decoded(mesh.triangles, Uint32Array);
    const kind = decoded(mesh.kinds, Uint8Array);
    const place = new Float32Array(3 * corner.length);
    const color = new Float32Array(3 * corner.length);
    corner.forEach((v, i) => {
      const paint = new THREE.Color(method.ours ? data.kinds[kind[Math.floor(i / 3)]] : method.color);
      for (let k = 0; k < 3; k++) place[3 * i + k] = vertex[3 * v + k];
      paint.toArray(color, 3 * i);
    });
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(place, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(color, 3));
    geometry.computeVertexNormals();
    const material = new THREE.MeshLambertMaterial({ vertexColors: true, flatShading: true, side: THREE.DoubleSide });
    // the edges lie in the faces and must be drawn over them
    Object.assign(material, { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
    if (!method.ours) {
      // behind our mesh where both lie in one plane
      Object.assign(material, { transparent: true, opacity: 0.55, depthWrite: false, polygonOffsetFactor: 2 });
    }
    const group = new THREE.Group();
    group.add(new THREE.Mesh(geometry, material));
    const line = new THREE.LineBasicMaterial({ color: method.ours ? "#222222" : method.color });
    group.add(new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 1), line));
    return group;
  }

  function clear(group) {
    group.traverse((part) => {
      part.geometry?.dispose();
      part.material?.dispose();
    });
    scene.remove(group);
  }

  function aim() {
    const [low, high] = current.bounds;
    const middle = new THREE.Vector3(...low.map((value, i) => (value + high[i]) / 2));
    const radius = Math.max(Math.hypot(...low.map((value, i) => high[i] - value)) / 2, 1);
    // the bounding sphere fits into the narrower side of the picture
    const half = ((camera.fov / 2) * Math.PI) / 180;
    const reach = radius / Math.sin(Math.min(half, Math.atan(Math.tan(half) * camera.aspect)));
    // a building does not fill its bounding sphere
    const eye = new THREE.Vector3(-0.49, -0.69, 0.53).setLength(0.9 * reach);
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
    const swatch = document.createElement("i");
    swatch.style.background = color;
    const whole = document.createElement("label");
    whole.append(box, swatch, label);
    return whole;
  }

  function show(index) {
    current = data.buildings[index];
    clear(parts);
    parts = new THREE.Group();
    const add = (part, key) => {
      part.name = key;
      part.visible = visible[key];
      parts.add(part);
    };
    add(pointsOf(current), "points");
    const descriptions = [];
    for (const method of data.methods) {
      const mesh = current.meshes[method.key];
      if (mesh) add(meshOf(mesh, method), method.key);
      descriptions.push(`${method.name}: ${mesh ? mesh.facts : "no mesh"}`);
    }
    scene.add(parts);
    layers.replaceChildren(
      toggle("points", "Points", "linear-gradient(90deg, #30123b, #28bceb, #a4fc3c, #fb7e21, #7a0403)"),
      ...data.methods.map((method) => toggle(method.key, method.name, method.color)),
    );
    facts.textContent = `${current.about}. ${descriptions.join("; ")}.`;
    canvas.dataset.building = current.id;
    canvas.setAttribute("aria-label", `3D view of building ${current.id}`);
    aim();
  }

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
    show(select.selectedIndex);
  };
  select.addEventListener("change", () => show(select.selectedIndex));
  root.querySelector(".previous").addEventListener("click", () => step(-1));
  root.querySelector(".next").addEventListener("click", () => step(1));
  root.querySelector(".reset").addEventListener("click", aim);
  new ResizeObserver(() => {
    const { clientWidth, clientHeight } = canvas;
    if (!clientWidth || !clientHeight) return;
    renderer.setSize(clientWidth, clientHeight, false);
    camera.aspect = clientWidth / clientHeight;
    camera.updateProjectionMatrix();
    draw();
  }).observe(canvas);
  camera.aspect = canvas.clientWidth / canvas.clientHeight || 1;
  show(0);
})();
