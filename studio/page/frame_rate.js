// Keeps the 3D view fluent where drawing is slow: fewer pixels and coarser meshes while the camera or things move, all
// of both when they rest, and no drawing while nothing changes. `?fixedDpr=1` leaves viser as it is.
(() => {
  if (new URLSearchParams(location.search).has("fixedDpr")) return;

  const SLOW_MS = 40; // between two frames
  const QUICK_MS = 22;
  const FRAMES = 4; // between two decisions
  const PAUSE_MS = 1500; // longer than any frame: the page was hidden or stood still
  const REST_MS = 300; // without a move, until the view is drawn in full
  const STILL_MS = 900; // without any change, until it is drawn larger
  const HEARTBEAT_MS = 1000; // viser draws this often, whether something changed or not
  const LATE_MS = 3000; // after a change, heartbeats still draw what came late, such as textures
  const ERROR_M = 0.01; // of coarser meshes
  const SMALL = 300; // triangles of a mesh that stays as it is
  const STALL_MS = 20; // a frame may be delayed this much by simplifying
  // From full to cheapest: share of the resolution, and whether meshes are coarse.
  const LADDER = [[1, false], [1, true], [0.7, true], [0.5, true], [0.35, true]];
  const FIRST_IN_SOFTWARE = 3; // where others would take seconds to be found too slow

  // A processor pays for each sample of a pixel. The view is drawn larger instead, once, when it has come to rest.
  const inSoftware = drawsInSoftware();
  const LARGER = inSoftware ? 2 : 1;
  if (inSoftware) drawWithoutSamples();
  let beating = false;
  markHeartbeats();
  const looking = setInterval(() => {
    const viser = window.__viserMutable;
    const store = viser?.scene?.__r3f?.root;
    if (!store) return;
    clearInterval(looking);
    takeOver(viser, store);
  }, 50);

  function drawsInSoftware() {
    const gl = document.createElement("canvas").getContext("webgl2");
    const names = gl?.getExtension("WEBGL_debug_renderer_info");
    const name = names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|basic render/i.test(name);
  }

  function drawWithoutSamples() {
    const get = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, wanted) {
      return get.call(this, kind, kind === "webgl2" ? { ...wanted, antialias: false } : wanted);
    };
  }

  function markHeartbeats() {
    const repeat = window.setInterval;
    window.setInterval = (call, ms, ...rest) => {
      if (ms !== HEARTBEAT_MS) return repeat(call, ms, ...rest);
      return repeat(() => {
        beating = true;
        try {
          call(...rest);
        } finally {
          beating = false;
        }
      }, ms);
    };
  }

  function takeOver(viser, store) {
    const { gl, scene, setDpr, invalidate } = store.getState();
    const draw = gl.render.bind(gl);
    const moved = poseWatch(viser);
    const meshes = coarseMeshes(scene);
    let rung = inSoftware ? FIRST_IN_SOFTWARE : 0, moving = false, still = false, restTimer = 0, stillTimer = 0;
    let last = 0, spent = 0, frames = 0, mean = SLOW_MS;
    let changed = performance.now();

    // viser's own rule lowers the resolution to three quarters at most, also of the view at rest.
    store.setState({
      setDpr: () => {},
      invalidate: (count) => {
        if (!beating) change();
        else if (performance.now() - changed > LATE_MS) return;
        invalidate(count);
      },
    });
    gl.render = (drawn, camera) => {
      if (drawn !== scene) return draw(drawn, camera);
      if (viser.getRenderRequestState === "capture") {
        meshes.show(false);
        gl.setPixelRatio(devicePixelRatio * LARGER);
        return draw(drawn, camera);
      }
      if (moved(camera)) move();
      const [share, coarse] = moving ? LADDER[rung] : [still ? LARGER : 1, false];
      meshes.show(coarse);
      const ratio = devicePixelRatio * share;
      if (store.getState().viewport.dpr !== ratio) setDpr(ratio);
      if (gl.getPixelRatio() !== ratio) gl.setPixelRatio(ratio);
      last = performance.now();
      draw(drawn, camera);
    };
    change();
    invalidate();

    function change() {
      changed = performance.now();
      if (LARGER === 1) return;
      still = false;
      clearTimeout(stillTimer);
      stillTimer = setTimeout(() => {
        still = true;
        invalidate();
        meshes.find();
        meshes.prepare();
      }, STILL_MS);
    }

    function move() {
      if (moving) {
        learn(performance.now() - last);
      } else {
        if (mean < QUICK_MS) rung = Math.max(rung - 1, 0);
        moving = true;
        spent = frames = 0;
        mean = SLOW_MS;
        meshes.find();
      }
      clearTimeout(restTimer);
      restTimer = setTimeout(rest, REST_MS);
    }

    function learn(ms) {
      if (ms > PAUSE_MS) return;
      spent += ms;
      if (++frames < FRAMES) return;
      mean = spent / frames;
      spent = frames = 0;
      if (mean > SLOW_MS) rung = Math.min(rung + (mean > 2 * SLOW_MS ? 2 : 1), LADDER.length - 1);
    }

    function rest() {
      moving = false;
      invalidate();
    }
  }

  // Returns a function that says whether the camera or a node has moved since it was last called.
  function poseWatch(viser) {
    let poses = new Float64Array(64), count = 0, at = 0, differs = false;
    function look(value) {
      if (at === poses.length) {
        const more = new Float64Array(2 * at);
        more.set(poses);
        poses = more;
      }
      if (poses[at] !== value) {
        poses[at] = value;
        differs = true;
      }
      at++;
    }
    function lookAt(node) {
      const { position: p, quaternion: q } = node;
      look(p.x), look(p.y), look(p.z), look(q.x), look(q.y), look(q.z), look(q.w);
    }
    return (camera) => {
      at = 0;
      differs = false;
      lookAt(camera);
      look(camera.fov);
      for (const name in viser.nodeRefFromName) {
        const node = viser.nodeRefFromName[name];
        if (node) lookAt(node);
      }
      const same = at === count; // more or fewer nodes: something was shown or hidden, nothing moved
      count = at;
      return differs && same;
    };
  }

  // Swaps the triangles of meshes for fewer ones over the same vertices, so that texture coordinates stay valid.
  function coarseMeshes(scene) {
    const known = new Map(); // geometry -> its triangles, in full and coarse (null: not simplified yet)
    let coarse = false;
    return { find, prepare, show };

    function find() {
      const seen = new Set();
      scene.traverse((node) => {
        const { index, attributes } = node.geometry ?? {};
        if (!node.isMesh || node.isInstancedMesh || node.isSkinnedMesh || !index) return;
        if (index.count < 3 * SMALL || !node.material.map) return; // colors of vertices would vanish with them
        const { position } = attributes;
        if (!position?.isBufferAttribute || position.itemSize !== 3 || !(position.array instanceof Float32Array)) return;
        seen.add(node.geometry);
        if (!known.has(node.geometry)) known.set(node.geometry, { full: index, coarse: null });
      });
      for (const geometry of known.keys()) if (!seen.has(geometry)) known.delete(geometry);
    }

    function prepare(limitMs = Infinity) {
      const start = performance.now();
      for (const [geometry, triangles] of known) {
        if (performance.now() - start > limitMs) return;
        triangles.coarse ??= simplified(geometry, triangles.full);
      }
    }

    function show(wanted) {
      if (!wanted && !coarse) return;
      coarse = wanted;
      if (wanted) prepare(STALL_MS);
      for (const [geometry, triangles] of known) {
        const index = (wanted && triangles.coarse) || triangles.full;
        if (geometry.index !== index) geometry.setIndex(index);
      }
    }

    function simplified(geometry, full) {
      const faces = Uint32Array.from(full.array), { array } = geometry.attributes.position;
      const [few] = MeshoptSimplifier.simplify(faces, array, 3, 0, ERROR_M, ["ErrorAbsolute"]);
      return few.length ? new full.constructor(new full.array.constructor(few), 1) : full;
    }
  }
})();
