// A mirror's surface in 3D: facets are coloured quadrilaterals, far ones first; drag or arrow keys turn it.
"use strict";
(() => {
  const view = (canvas) => {
    const { size, middle, bound, facets, colours } = JSON.parse(canvas.dataset.surface);
    const context = canvas.getContext("2d"), said = document.querySelector("[data-exaggeration]");
    const highest = Math.max(...facets.flatMap((facet) => facet.heights).flat().map(Math.abs), 1e-3);
    let azimuth = -0.6, tilt = 0.9, factor = 0.12 * size[0] * 1000 / highest; // mm are drawn as metres; the highest point is a tenth of the width

    // Each facet has its centre and half sides; i runs along x, j along y. Heights are null beside its outline.
    const quads = facets.flatMap(({ center, x, y, heights }) => {
      const n = heights.length, found = [];
      const point = (i, j) => {
        const u = 2 * i / (n - 1) - 1, v = 2 * j / (n - 1) - 1;
        return [center[0] - middle[0] + u * x[0] + v * y[0], center[1] - middle[1] + u * x[1] + v * y[1], heights[i][j]];
      };
      for (let i = 0; i + 1 < n; i++) for (let j = 0; j + 1 < n; j++) {
        const quad = [point(i, j), point(i + 1, j), point(i + 1, j + 1), point(i, j + 1)].filter((corner) => corner[2] !== null);
        if (quad.length > 2) found.push(quad);
      }
      return found;
    });

    const draw = () => {
      const scale = 0.66 * Math.min(canvas.width / size[0], 1.2 * canvas.height / size[1]);
      const [ca, sa, ct, st] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(tilt), Math.sin(tilt)];
      const turned = ([x, y, z]) => {
        const up = z * factor / 1000, a = ca * x - sa * y, b = sa * x + ca * y;
        return [canvas.width / 2 + scale * a, canvas.height / 2 - scale * (b * ct + up * st), b * st - up * ct];
      };
      context.clearRect(0, 0, canvas.width, canvas.height);
      const drawn = quads.map((quad) => {
        const corners = quad.map(turned), mean = quad.reduce((sum, p) => sum + p[2], 0) / quad.length;
        return { corners, mean, depth: corners.reduce((sum, p) => sum + p[2], 0) / corners.length };
      }).sort((a, b) => b.depth - a.depth);
      for (const { corners, mean } of drawn) {
        context.beginPath();
        corners.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
        context.closePath();
        context.fillStyle = colours[Math.round((Math.min(Math.max(mean / bound, -1), 1) + 1) / 2 * (colours.length - 1))];
        context.strokeStyle = "rgba(28, 41, 46, 0.28)";
        context.fill();
        context.stroke();
      }
      if (said) said.value = String(Number(factor.toPrecision(2)));
    };

    const turn = (across, along) => {
      azimuth += across;
      tilt = Math.min(Math.max(tilt + along, 0.05), 1.5);
      draw();
    };
    const keys = {
      ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.08), ArrowDown: () => turn(0, 0.08),
      "+": () => { factor *= 1.25; draw(); }, "-": () => { factor /= 1.25; draw(); },
    };
    canvas.addEventListener("keydown", (event) => {
      if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
    });
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) turn(event.movementX * 0.008, event.pointerType === "touch" ? 0 : event.movementY * 0.008);
    });
    draw();
  };

  document.querySelectorAll("canvas[data-surface]").forEach(view);
})();
