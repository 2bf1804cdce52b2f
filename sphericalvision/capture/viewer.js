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
  const { canvas, camera, scene, renderer, draw } = view("panorama", 75, 0.1, 10);
  // The middle of the picture is forward, -z here; columns grow to the right.
  const sphere = new SphereGeometry(1, 96, 48);
  sphere.scale(-1, 1, 1);
  const names = data.frames[0].pictures.map((picture) => picture.name);
  const borders = names.map(() => ({ value: 0 }));
  const layers = names.map((_, number) => {
    const material = new MeshBasicMaterial({ transparent: true, depthWrite: false });
    // A picture covers the right of the window, from a border that the slide moves.
    material.onBeforeCompile = (shader) => {
      shader.uniforms.border = borders[number];
      shader.fragmentShader = "uniform float border;\n" + shader.fragmentShader
        .replace("#include <map_fragment>", "if (gl_FragCoord.x < border) discard;\n#include <map_fragment>");
    };
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
    borders.forEach((border, number) => {
      border.value = (1 - Math.max(0, Math.min(1, place - number + 1))) * renderer.domElement.width * (number > 0);
    });
    label.textContent = place % 1 ? `${names[Math.floor(place)]} | ${names[Math.ceil(place)]}` : names[place];
    draw();
  };
  slider.addEventListener("input", slide);
  new ResizeObserver(() => requestAnimationFrame(slide)).observe(canvas);
  slide();
  look();
  return { show, turn, zoom, canvas, camera };
}

function cloud() {
  const { canvas, camera, scene, renderer, draw } = view("cloud", 75, 0.002 * data.radius, 10000);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = () => { scene.background = new Color(dark.matches ? 0x15191d : 0xdde7ef); };
  dark.addEventListener("change", () => { paint(); draw(); });
  paint();
  const geometry = new BufferGeometry();
  const material = new PointsMaterial({ vertexColors: true });
  // Directions are spread evenly, so what a point stands for grows with its distance from the rig.
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace("gl_PointSize = size;", "gl_PointSize = size * length(position);")
      .replace("#include <logdepthbuf_vertex>", "gl_PointSize = clamp(gl_PointSize, 1.0, 24.0);\n#include <logdepthbuf_vertex>")
      .replace("#include <color_vertex>", "#include <color_vertex>\nvColor.rgb = pow(vColor.rgb, vec3(2.2));");  // of images
  };
  scene.add(new Points(geometry, material));
  const controls = new OrbitControls(camera, canvas);
  controls.zoomSpeed = 3;
  controls.minDistance = 0.005 * data.radius;
  controls.maxDistance = 8 * data.reach;
  controls.addEventListener("change", draw);
  let inside = true;  // before the first change, which shows the points from outside
  const where = document.getElementById("where"), cut = document.getElementById("cut");
  const go = () => {
    inside = !inside;
    where.textContent = inside ? "from outside" : "from inside";
    controls.rotateSpeed = inside ? -0.5 : 1;  // inside the picture is what is dragged, not the camera
    // From outside the ball of most points fills the window, and what is above the rig is cut.
    const outside = new Vector3(0.26, 0.58, 0.77).multiplyScalar(1.3 * data.reach);
    controls.target.set(0, 0, 0);
    camera.position.copy(inside ? new Vector3(0, 0, 0.01 * data.radius) : outside);
    controls.update();
    cut.checked = !inside;
    clip();
  };
  const clip = () => {
    renderer.clippingPlanes = cut.checked ? [new Plane(new Vector3(0, -1, 0), 0.1 * data.radius)] : [];
    draw();
  };
  where.addEventListener("click", go);
  cut.addEventListener("change", clip);
  go();
  const count = document.getElementById("number");
  let points = new Float32Array();
  // Metres of the point that lies nearest to a direction, if one lies within three degrees of it.
  const distance = ({ x, y, z }) => {
    let best = 0.9986, metres = null;
    for (let i = 0; i < points.length; i += 3) {
      const length = Math.hypot(points[i], points[i + 1], points[i + 2]);
      const cosine = (points[i] * x + points[i + 1] * y + points[i + 2] * z) / length;
      if (cosine > best) [best, metres] = [cosine, length];
    }
    return metres;
  };
  const show = (frame) => {
    points = new Float32Array(bytes(frame.points));
    geometry.setAttribute("position", new BufferAttribute(points, 3));
    geometry.setAttribute("color", new BufferAttribute(new Uint8Array(bytes(frame.colors)), 3, true));
    geometry.computeBoundingSphere();
    count.textContent = points.length / 3;
    material.size = 2 * Math.sqrt((4 * Math.PI) / Math.max(1, points.length / 3));
    draw();
  };
  return { show, where, cut, distance };
}

const around = panorama(), points = cloud();
around.canvas.addEventListener("pointermove", (event) => {
  const { clientWidth: width, clientHeight: height } = around.canvas;
  around.camera.updateMatrixWorld();
  const ray = new Vector3((2 * event.offsetX) / width - 1, 1 - (2 * event.offsetY) / height, 0.5)
    .unproject(around.camera).normalize();
  const metres = points.distance(ray);
  document.getElementById("metres").textContent = metres ? `${metres.toPrecision(3)} m` : "–";
});
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
