// SPDX-License-Identifier: Apache-2.0
// Runs in the page after three.min.js, which is: npm install three@0.187.0 esbuild, then of a file that exports the names
// below from "three" and its OrbitControls:  npx esbuild parts.js --bundle --minify --format=iife --global-name=THREE
// --legal-comments=eof --outfile=three.min.js
// Two views of a frame: a panorama from inside, which fades between pictures, and points, from inside and from outside.
// A time line goes from frame to frame.
const {
  BufferAttribute, BufferGeometry, Color, Mesh, MeshBasicMaterial, OrbitControls, PerspectiveCamera, Plane, Points,
  PointsMaterial, Scene, SphereGeometry, SRGBColorSpace, TextureLoader, Vector3, WebGLRenderer,
} = THREE;
const data = JSON.parse(document.getElementById("data").textContent);

function bytes(base64) {
  return Uint8Array.from(atob(base64), (c) => c.charCodeAt(0)).buffer;
}

function view(id, fieldOfView, near, far) {
  const canvas = document.getElementById(id);
  const renderer = new WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  const camera = new PerspectiveCamera(fieldOfView, 1, near, far);
  const scene = new Scene();
  const draw = () => renderer.render(scene, camera);
  const resize = () => {
    const { clientWidth: width, clientHeight: height } = canvas;
    renderer.setPixelRatio(window.devicePixelRatio);
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    draw();
  };
  new ResizeObserver(resize).observe(canvas);
  return { canvas, camera, scene, renderer, draw };
}

function panorama() {
  const { canvas, camera, scene, draw } = view("panorama", 75, 0.1, 10);
  // The middle of the picture is forward, -z here; columns grow to the right.
  const sphere = new SphereGeometry(1, 96, 48);
  sphere.scale(-1, 1, 1);
  const names = data.frames[0].pictures.map((picture) => picture.name);
  const layers = names.map((_, number) => {
    const material = new MeshBasicMaterial({ transparent: true, opacity: number ? 0 : 1, depthWrite: false });
    const mesh = new Mesh(sphere, material);
    mesh.rotation.y = -Math.PI / 2;
    mesh.renderOrder = number;
    scene.add(mesh);
    return material;
  });
  const loader = new TextureLoader();
  // All pictures of a frame are there before the first of them is shown, so that nothing flickers.
  const show = (frame) => Promise.all(frame.pictures.map((picture) => loader.loadAsync(picture.url))).then((maps) => {
    maps.forEach((map, number) => {
      map.colorSpace = SRGBColorSpace;
      layers[number].map?.dispose();
      layers[number].map = map;
      layers[number].needsUpdate = true;
    });
    draw();
  });
  let yaw = 0, pitch = 0;
  const look = () => {
    camera.rotation.set(pitch, yaw, 0, "YXZ");
    draw();
  };
  const turn = (right, down) => {
    yaw += right;
    pitch = Math.max(-1.55, Math.min(1.55, pitch + down));
    look();
  };
  const zoom = (factor) => {
    camera.fov = Math.max(20, Math.min(110, camera.fov * factor));
    camera.updateProjectionMatrix();
    draw();
  };
  // One finger or the mouse turns, two fingers zoom.
  const fingers = new Map();
  const apart = () => {
    const [one, other] = [...fingers.values()];
    return Math.hypot(one.x - other.x, one.y - other.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId), now = { x: event.clientX, y: event.clientY };
    if (!before) return;
    const width = fingers.size === 2 ? apart() : 0;
    fingers.set(event.pointerId, now);
    const perPixel = (camera.fov * Math.PI) / 180 / canvas.clientHeight;
    if (fingers.size === 1) turn((now.x - before.x) * perPixel, (now.y - before.y) * perPixel);
    else if (width) zoom(width / Math.max(1, apart()));
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(event.deltaY / 1000));
  }, { passive: false });
  const slider = document.getElementById("slide"), label = document.getElementById("shown");
  slider.max = names.length - 1;
  const slide = () => {
    const place = Number(slider.value);
    layers.forEach((material, number) => {
      material.opacity = number ? Math.max(0, Math.min(1, place - number + 1)) : 1;
    });
    label.textContent = names[Math.round(place)];
    draw();
  };
  slider.addEventListener("input", slide);
  slide();
  look();
  return { show, turn, zoom };
}

function cloud() {
  const { canvas, camera, scene, renderer, draw } = view("cloud", 75, 0.002 * data.radius, 10000);
  scene.background = new Color(0xdde7ef);
  const geometry = new BufferGeometry();
  const material = new PointsMaterial({ vertexColors: true });
  // Directions are spread evenly, so what a point stands for grows with its distance from the rig.
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace("gl_PointSize = size;", "gl_PointSize = size * length(position);")
      .replace("#include <color_vertex>", "#include <color_vertex>\nvColor.rgb = pow(vColor.rgb, vec3(2.2));");  // of images
  };
  scene.add(new Points(geometry, material));
  const controls = new OrbitControls(camera, canvas);
  controls.zoomSpeed = 3;
  controls.addEventListener("change", draw);
  let inside = false;
  const where = document.getElementById("where"), cut = document.getElementById("cut");
  const go = () => {
    inside = !inside;
    where.textContent = inside ? "from outside" : "from inside";
    controls.rotateSpeed = inside ? -0.5 : 1;  // inside the picture is what is dragged, not the camera
    camera.position.set(...(inside ? [0, 0, 0.01] : [0.8, 1.8, 2.4])).multiplyScalar(data.radius);
    controls.update();
    draw();
  };
  where.addEventListener("click", go);
  cut.addEventListener("change", () => {
    renderer.clippingPlanes = cut.checked ? [new Plane(new Vector3(0, -1, 0), 0.1 * data.radius)] : [];
    draw();
  });
  go();
  const count = document.getElementById("number");
  const show = (frame) => {
    const points = new Float32Array(bytes(frame.points));
    geometry.setAttribute("position", new BufferAttribute(points, 3));
    geometry.setAttribute("color", new BufferAttribute(new Uint8Array(bytes(frame.colors)), 3, true));
    geometry.computeBoundingSphere();
    count.textContent = points.length / 3;
    material.size = 2 * Math.sqrt((4 * Math.PI) / Math.max(1, points.length / 3));
    draw();
  };
  return { show, where, cut };
}

const around = panorama(), points = cloud();
const time = document.getElementById("time"), play = document.getElementById("play");
const name = document.getElementById("frame");
let wanted = 0, showing = Promise.resolve(), playing = null;

// Frames are shown one after the other; those that were passed over in the meantime are left out.
function go(number) {
  wanted = number;
  time.value = number;
  showing = showing.then(async () => {
    if (number !== wanted) return;
    const frame = data.frames[number];
    await around.show(frame);
    points.show(frame);
    name.textContent = frame.name;
    document.body.dataset.frame = number;
  });
  return showing;
}

async function next() {
  if (!playing) return;
  const started = performance.now();
  await go((wanted + 1) % data.frames.length);
  setTimeout(next, Math.max(0, 200 - (performance.now() - started)));
}

document.getElementById("times").hidden = data.frames.length < 2;
time.max = data.frames.length - 1;
time.addEventListener("input", () => go(Number(time.value)));
play.addEventListener("click", () => {
  playing = !playing;
  play.textContent = playing ? "pause" : "play";
  next();
});
const keys = {
  ArrowLeft: () => around.turn(0.1, 0), ArrowRight: () => around.turn(-0.1, 0),
  ArrowUp: () => around.turn(0, 0.1), ArrowDown: () => around.turn(0, -0.1),
  "+": () => around.zoom(0.9), "-": () => around.zoom(1.1),
  i: () => points.where.click(), c: () => points.cut.click(), p: () => play.click(),
};
document.addEventListener("keydown", (event) => {
  if (event.target.tagName === "INPUT" && event.target.type === "range" || event.ctrlKey || event.metaKey || !keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});
go(0).then(() => { document.body.dataset.ready = "yes"; });
