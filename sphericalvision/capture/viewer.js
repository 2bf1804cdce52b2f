// SPDX-License-Identifier: Apache-2.0
// Bundled with three.js into viewer.min.js: npm install three@0.187.0 esbuild, then
// npx esbuild viewer.js --bundle --minify --format=iife --legal-comments=eof --outfile=viewer.min.js
// Two views of a frame: a panorama from inside, which fades between pictures, and points to orbit around.
// A time line goes from frame to frame.
import {
  BufferAttribute, BufferGeometry, Mesh, MeshBasicMaterial, PerspectiveCamera, Points, PointsMaterial, Scene,
  SphereGeometry, SRGBColorSpace, TextureLoader, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

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
  return { canvas, camera, scene, draw };
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
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    const perPixel = (camera.fov * Math.PI) / 180 / canvas.clientHeight;
    yaw += event.movementX * perPixel;
    pitch = Math.max(-1.55, Math.min(1.55, pitch + event.movementY * perPixel));
    look();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.fov = Math.max(20, Math.min(110, camera.fov * Math.exp(event.deltaY / 1000)));
    camera.updateProjectionMatrix();
    draw();
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
  return show;
}

function cloud() {
  const { canvas, camera, scene, draw } = view("cloud", 60, 0.01, 10000);
  const geometry = new BufferGeometry();
  scene.add(new Points(geometry, new PointsMaterial({ size: 0.02 * data.radius ** 0.5, vertexColors: true })));
  camera.position.set(0.6, 1.2, 1.8).multiplyScalar(data.radius);
  const controls = new OrbitControls(camera, canvas);
  controls.addEventListener("change", draw);
  controls.update();
  const count = document.getElementById("number");
  return (frame) => {
    const points = new Float32Array(bytes(frame.points));
    geometry.setAttribute("position", new BufferAttribute(points, 3));
    geometry.setAttribute("color", new BufferAttribute(new Uint8Array(bytes(frame.colors)), 3, true));
    geometry.computeBoundingSphere();
    count.textContent = points.length / 3;
    draw();
  };
}

const showPanorama = panorama(), showCloud = cloud();
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
    await showPanorama(frame);
    showCloud(frame);
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
go(0).then(() => { document.body.dataset.ready = "yes"; });
