// SPDX-License-Identifier: Apache-2.0
// Bundled with three.js into viewer.min.js: npm install three@0.187.0 esbuild, then
// npx esbuild viewer.js --bundle --minify --format=iife --legal-comments=eof --outfile=viewer.min.js
// Two views of one frame: a panorama from inside, which fades between pictures, and points to orbit around.
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
  const layers = data.pictures.map((picture, number) => {
    const map = new TextureLoader().load(picture.url, draw);
    map.colorSpace = SRGBColorSpace;
    const material = new MeshBasicMaterial({ map, transparent: true, opacity: number ? 0 : 1, depthWrite: false });
    const mesh = new Mesh(sphere, material);
    mesh.rotation.y = -Math.PI / 2;
    mesh.renderOrder = number;
    scene.add(mesh);
    return material;
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
  slider.max = data.pictures.length - 1;
  const slide = () => {
    const place = Number(slider.value);
    layers.forEach((material, number) => {
      material.opacity = number ? Math.max(0, Math.min(1, place - number + 1)) : 1;
    });
    label.textContent = data.pictures[Math.round(place)].name;
    draw();
  };
  slider.addEventListener("input", slide);
  slide();
  look();
}

function cloud() {
  const { canvas, camera, scene, draw } = view("cloud", 60, 0.01, 10000);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(bytes(data.points)), 3));
  geometry.setAttribute("color", new BufferAttribute(new Uint8Array(bytes(data.colors)), 3, true));
  scene.add(new Points(geometry, new PointsMaterial({ size: 0.02 * data.radius ** 0.5, vertexColors: true })));
  camera.position.set(0.6, 1.2, 1.8).multiplyScalar(data.radius);
  const controls = new OrbitControls(camera, canvas);
  controls.addEventListener("change", draw);
  controls.update();
  draw();
}

panorama();
cloud();
document.body.dataset.ready = "yes";
