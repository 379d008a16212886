// The organ in three dimensions: its surface where it was and where it went, and the regions that hold places.
import * as THREE from "three";
import { OrbitControls } from "orbit-controls";

const figure = document.getElementById("three-d");
const data = JSON.parse(document.getElementById("three-d-data").textContent);
const stage = figure.querySelector(".stage");

function start() {
  const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true, preserveDrawingBuffer: true });
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  stage.prepend(renderer.domElement);
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(30, 1, data.size / 100, data.size * 20);
  // World RAS: up is superior; seen from the front, right and above.
  camera.up.set(0, 0, 1);
  camera.position.set(...data.centre).add(new THREE.Vector3(0.8, 1.7, 0.7).multiplyScalar(data.size));
  const controls = new OrbitControls(camera, renderer.domElement);
  controls.target.set(...data.centre);
  controls.update();
  const light = new THREE.DirectionalLight(0xffffff, 2.0);
  camera.add(light);
  scene.add(camera, new THREE.AmbientLight(0xffffff, 1.2));

  const shells = data.shells.map((shell) => {
    const geometry = new THREE.BufferGeometry();
    geometry.setIndex(shell.faces.flat());
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(shell.points.flat(), 3));
    const material = new THREE.MeshStandardMaterial({
      roughness: 0.85, side: shell.colours ? THREE.FrontSide : THREE.DoubleSide, transparent: Boolean(shell.colours),
      vertexColors: Boolean(shell.colours), color: shell.colours ? 0xffffff : new THREE.Color(shell.colour),
    });
    const mesh = new THREE.Mesh(geometry, material);
    scene.add(mesh);
    return { shell, geometry, material, mesh };
  });
  const ball = new THREE.SphereGeometry(1, 24, 16);
  const places = data.places.map((place) => {
    const mesh = new THREE.Mesh(ball, new THREE.MeshStandardMaterial({ color: 0xe8891c, roughness: 0.6 }));
    mesh.matrixAutoUpdate = false;
    scene.add(mesh);
    const label = document.createElement("span");
    label.textContent = place.name;
    stage.append(label);
    return { place, mesh, label };
  });

  const input = (name) => figure.querySelector(`[name=${name}]`);
  const draw = () => {
    const moved = Number(input("moved").value) * Number(input("enlarge").value);
    const enlarge = Number(input("enlarge").value), opacity = Number(input("opacity").value);
    for (const { shell, geometry, material, mesh } of shells) {
      const position = geometry.getAttribute("position");
      shell.points.forEach((p, k) => position.setXYZ(k, ...p.map((x, axis) => x + moved * shell.moved[k][axis])));
      position.needsUpdate = true;
      geometry.computeVertexNormals();
      if (shell.colours) {
        geometry.setAttribute("color", new THREE.Float32BufferAttribute(shell.colours[input("colour").value], 3));
        material.opacity = opacity;
        material.depthWrite = opacity === 1;
        mesh.visible = opacity > 0;
      }
    }
    for (const { place, mesh } of places) {
      const axes = place.axes.map((axis, k) => new THREE.Vector3(...axis).multiplyScalar(enlarge * place.half[k]));
      mesh.matrix.makeBasis(...axes);
      mesh.matrix.setPosition(...place.point.map((x, axis) => x + moved * place.moved[axis]));
    }
    figure.querySelectorAll(".scale").forEach((scale) => { scale.hidden = scale.dataset.name !== input("colour").value; });
    render();
  };
  const corner = new THREE.Vector3();
  const render = () => {
    renderer.render(scene, camera);
    for (const { mesh, label } of places) {
      corner.setFromMatrixPosition(mesh.matrix).project(camera);
      label.style.left = `${(corner.x + 1) * 50}%`;
      label.style.top = `${(1 - corner.y) * 50}%`;
    }
  };
  const resize = () => {
    const width = stage.clientWidth, height = Math.round(Math.min(0.62 * width, 620));
    // The page may get narrower without a word, as in print: the canvas follows it, and the labels are in per cent.
    renderer.setSize(width, height, false);
    stage.style.aspectRatio = `${width} / ${height}`;
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    render();
  };
  controls.addEventListener("change", render);
  figure.querySelectorAll("input, select").forEach((one) => one.addEventListener("input", draw));
  new ResizeObserver(resize).observe(stage);
  draw();
  resize();
}

if (document.createElement("canvas").getContext("webgl2")) start();
else stage.textContent = "This browser cannot draw in three dimensions (no WebGL 2).";
