/* Draws the scenes of a page: errors at places in space, which the reader can turn. */
(function () {
'use strict';
/* Viridis with a lighter low end, and a dark ground in both colour schemes: both ends stay visible. */
var VIRIDIS = [[122, 92, 168], [98, 100, 172], [70, 110, 166], [44, 122, 158], [33, 145, 140], [40, 174, 128],
  [94, 201, 98], [173, 220, 48], [253, 231, 37]];
var GROUND = '#10161d', INK = '#e4e9ee', EDGE = '#5b6875', FAINT = '#36424e';
var FONT = '12px system-ui, "DejaVu Sans", Arial, sans-serif';
var LONGEST = 0.13;  /* of the diagonal: the largest error at the initial magnification */
var STEPS = 20, TURN = Math.PI / 36, NEAR = 16, CHANGE_MS = 250;
var AZIMUTH = -62 * Math.PI / 180, ELEVATION = 24 * Math.PI / 180;
var LETTERS = 'XYZ';

function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
function sum(a, x, b, y) { return [a[0] * x + b[0] * y, a[1] * x + b[1] * y, a[2] * x + b[2] * y]; }
function unit(a) { var n = Math.sqrt(dot(a, a)); return [a[0] / n, a[1] / n, a[2] / n]; }
function length(a) { return Math.sqrt(dot(a, a)); }
function colour(share) {
  var at = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1), k = Math.min(Math.floor(at), VIRIDIS.length - 2);
  var mixed = VIRIDIS[k].map(function (c, i) { return Math.round(c + (VIRIDIS[k + 1][i] - c) * (at - k)); });
  return 'rgb(' + mixed.join(',') + ')';
}
function number(x, digits) {
  return String(Number(x.toPrecision(digits || 3))).replace('-', '\u2212');
}
function make(name, attributes, parent, text) {
  var one = document.createElement(name);
  Object.keys(attributes).forEach(function (key) { one.setAttribute(key, attributes[key]); });
  if (text) one.textContent = text;
  if (parent) parent.appendChild(one);
  return one;
}

/* Points of the places, their neighbours on a grid, and the errors of every layer in um. */
function unpack(data) {
  var places = data.places.map(function (one) {
    if (!one.nodes) {
      var free = [];
      for (var i = 0; i < one.points.length; i += 3) free.push({ at: one.points.slice(i, i + 3), index: null });
      return { points: free, nodes: null };
    }
    var points = [];
    one.nodes[0].forEach(function (x, i) {
      one.nodes[1].forEach(function (y, j) {
        one.nodes[2].forEach(function (z, k) { points.push({ at: [x, y, z], index: [i, j, k] }); });
      });
    });
    return { points: points, nodes: one.nodes };
  });
  var layers = data.layers.map(function (one) {
    var values = [];
    for (var i = 0; i < one.values.length; i += one.vectors ? 3 : 1) {
      var known = one.vectors ? one.values.slice(i, i + 3) : [one.values[i]];
      values.push(known.indexOf(null) < 0 ? known.map(function (v) { return v * one.step; }) : null);
    }
    var sizes = values.map(function (v) { return v === null ? 0 : v.length > 1 ? length(v) : v[0]; });
    return { name: one.name, places: places[one.places], vectors: one.vectors, values: values, sizes: sizes,
      top: Math.max.apply(null, sizes) };
  });
  return { title: data.title, up: unit(data.up), layers: layers };
}

function show(figure, number_of) {
  var scene = unpack(JSON.parse(figure.querySelector('script').textContent));
  var state = { layer: scene.layers[0], drawn: 'arrows', part: '', node: 0, power: 0, common: true,
    azimuth: AZIMUTH, elevation: ELEVATION, zoom: 1, from: null, share: 1 };
  var id = 'scene' + number_of;
  var caption = figure.querySelector('figcaption');
  var bar = make('div', { 'class': 'controls' });
  var canvas = make('canvas', { tabindex: '0', role: 'img', 'aria-describedby': id + 'status ' + id + 'keys' });
  var status = make('p', { id: id + 'status', role: 'status', 'class': 'soft' });
  var reading = make('p', { 'class': 'soft reading' });
  make('p', { 'class': 'heading' }, figure, scene.title);
  [bar, canvas, reading, status].forEach(function (one) { figure.appendChild(one); });
  make('p', { id: id + 'keys', 'class': 'soft' }, figure,
    'Keys on the picture: arrows turn it, + and \u2212 change its size, Home returns to the first view.');
  figure.appendChild(caption);
  figure.hidden = false;

  function field(words, control) {
    var label = make('label', {}, bar);
    make('span', {}, label, words);
    label.appendChild(control);
    return label;
  }
  function select(words, options, change) {
    var control = make('select', {});
    options.forEach(function (one) { make('option', { value: one[0] }, control, one[1]); });
    control.addEventListener('change', function () { change(control.value); });
    return field(words, control);
  }
  function range(words, low, high, change) {
    var control = make('input', { type: 'range', min: low, max: high, step: 1 });
    control.addEventListener('input', function () { change(Number(control.value)); });
    return field(words, control);
  }
  function button(words, act, name) {
    var one = make('button', name ? { type: 'button', 'aria-label': name } : { type: 'button' }, bar, words);
    one.addEventListener('click', act);
  }
  select('Shown', scene.layers.map(function (one, i) { return [i, one.name]; }), function (value) {
    var next = scene.layers[value], last = state.layer;
    state.from = next.places === last.places && next.vectors && last.vectors ? last : null;
    state.layer = next;
    adapt();
    change();
  });
  var drawn = select('Drawn as', [['arrows', 'arrows'], ['grid', 'deformed grid']], function (value) {
    state.drawn = value;
    draw();
  });
  var part = select('Part', [['', 'whole travel'], ['2', 'plane XY'], ['1', 'plane XZ'], ['0', 'plane YZ']],
    function (value) { state.part = value; adapt(); draw(); });
  var place = range('Position', 0, 1, function (value) { state.node = value; adapt(); draw(); });
  var power = range('Magnification', -STEPS, 2 * STEPS, function (value) { state.power = value; adapt(); draw(); });
  power.querySelector('input').value = 0;
  var common = make('input', { type: 'checkbox' });
  common.checked = true;
  common.addEventListener('change', function () { state.common = common.checked; adapt(); draw(); });
  field('One scale for all layers', common).className = 'tick';
  function look(azimuth, elevation) {
    return function () { state.azimuth = azimuth; state.elevation = elevation; draw(); };
  }
  button('from above', look(-Math.PI / 2, Math.PI / 2));
  button('from the front', look(-Math.PI / 2, 0));
  button('from the side', look(0, 0));
  button('first view', first);
  button('\u2212', function () { zoom(1 / 1.2); }, 'smaller');
  button('+', function () { zoom(1.2); }, 'larger');
  function first() { state.azimuth = AZIMUTH; state.elevation = ELEVATION; state.zoom = 1; draw(); }
  function zoom(by) { state.zoom = Math.min(Math.max(state.zoom * by, 0.3), 8); draw(); }

  /* The box of the places that are shown: positions of the axes and tool points differ by the tool. */
  var low, high, middle, diagonal;
  function enclose() {
    low = [Infinity, Infinity, Infinity];
    high = [-Infinity, -Infinity, -Infinity];
    state.layer.places.points.forEach(function (p) {
      p.at.forEach(function (x, i) { low[i] = Math.min(low[i], x); high[i] = Math.max(high[i], x); });
    });
    middle = sum(low, 0.5, high, 0.5);
    diagonal = length(sum(high, 1, low, -1)) || 1;
  }
  var first_axis = Math.abs(scene.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  first_axis = unit(sum(first_axis, 1, scene.up, -dot(first_axis, scene.up)));
  var second_axis = cross(scene.up, first_axis);
  var all = Math.max.apply(null, scene.layers.map(function (one) { return one.top; }));

  function top() { return (state.common ? all : state.layer.top) || 1; }
  function magnification() {
    var exact = LONGEST * diagonal / (1e-3 * top()) * Math.pow(10, state.power / STEPS);
    return Number(exact.toPrecision(2));
  }
  function chosen() {
    var layer = state.layer, nodes = layer.places.nodes;
    return function (p) {
      if (!nodes) return true;
      if (state.part !== '') return p.index[state.part] === state.node;
      return state.drawn === 'grid' && layer.vectors || p.index.every(function (i) { return i % 2 === 0; });
    };
  }
  /* The controls that apply to the layer, with their values in words. */
  function adapt() {
    var layer = state.layer, nodes = layer.places.nodes;
    enclose();
    drawn.hidden = !nodes || !layer.vectors;
    part.hidden = !nodes;
    place.hidden = !nodes || state.part === '';
    if (!place.hidden) {
      var line = nodes[state.part], slider = place.querySelector('input');
      if (slider.dataset.axis !== state.part) {
        slider.dataset.axis = state.part;
        state.node = (line.length - 1) / 2;
      }
      slider.max = line.length - 1;
      slider.value = state.node;
      var words = LETTERS[state.part] + ' = ' + number(line[state.node], 5) + ' mm';
      place.querySelector('span').textContent = 'Position ' + words;
      slider.setAttribute('aria-valuetext', words);
    }
    var by = '\u00d7 ' + String(magnification()).replace(/\B(?=(\d{3})+$)/g, '\u202f');
    power.querySelector('span').textContent = 'Magnification ' + by;
    power.querySelector('input').setAttribute('aria-valuetext', by);
    var inside = chosen(), squares = 0, count = 0, largest = -1;
    layer.places.points.forEach(function (p, i) {
      if (layer.values[i] === null || nodes && state.part !== '' && !inside(p)) return;
      squares += layer.sizes[i] * layer.sizes[i];
      count += 1;
      if (largest < 0 || layer.sizes[i] > layer.sizes[largest]) largest = i;
    });
    if (largest < 0) { status.textContent = ''; return; }
    status.textContent = layer.name + ': rms ' + number(Math.sqrt(squares / count)) + ' \u00b5m, largest ' +
      number(layer.sizes[largest]) + ' \u00b5m at ' + told(layer.places.points[largest].at) + '.';
    canvas.setAttribute('aria-label', scene.title + '. ' + status.textContent);
  }
  function told(at) {
    return at.map(function (x, i) { return LETTERS[i] + ' ' + number(x, 5); }).join(', ') + ' mm';
  }
  /* From one layer to the next the errors move, except where the reader wants no motion. */
  function change() {
    if (state.from === null || matchMedia('(prefers-reduced-motion: reduce)').matches) {
      state.from = null;
      draw();
      return;
    }
    var began = performance.now();
    (function step(now) {
      state.share = Math.min(Math.max((now - began) / CHANGE_MS, 0), 1);
      draw();
      if (state.share < 1) requestAnimationFrame(step); else state.from = null;
    })(began);
  }

  var context = canvas.getContext('2d'), shown = [];
  function draw() {
    var width = canvas.clientWidth, height = Math.round(Math.min(Math.max(0.6 * width, 320), 540));
    var fine = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * fine) || canvas.height !== Math.round(height * fine)) {
      canvas.width = Math.round(width * fine);
      canvas.height = Math.round(height * fine);
      canvas.style.height = height + 'px';
    }
    context.setTransform(fine, 0, 0, fine, 0, 0);
    context.fillStyle = GROUND;
    context.fillRect(0, 0, width, height);
    var level = sum(first_axis, Math.cos(state.azimuth), second_axis, Math.sin(state.azimuth));
    var toward = sum(level, Math.cos(state.elevation), scene.up, Math.sin(state.elevation));
    var right = sum(second_axis, Math.cos(state.azimuth), first_axis, -Math.sin(state.azimuth));
    var upward = cross(toward, right);
    var room = height - 56, scale = state.zoom * Math.min(width - 90, 1.25 * room) / diagonal;
    function on(p) {
      var d = sum(p, 1, middle, -1);
      return [width / 2 + scale * dot(d, right), room / 2 + 4 - scale * dot(d, upward), dot(d, toward)];
    }
    box(on, width, room);
    var layer = state.layer, inside = chosen(), by = 1e-3 * magnification(), items = [];
    shown = [];
    layer.places.points.forEach(function (p, i) {
      var value = layer.values[i];
      if (value === null || !inside(p)) return;
      var from = state.from && state.from.values[i];
      if (from) value = sum(from, 1 - state.share, value, state.share);
      var at = on(p.at), end = layer.vectors ? on(sum(p.at, 1, value, by)) : at;
      shown.push({ point: p, at: at, i: i });
      items.push({ at: at, end: end, depth: at[2], size: layer.vectors ? length(value) : value[0], p: p });
    });
    if (state.drawn === 'grid' && layer.vectors && layer.places.nodes) grid(items);
    else {
      items.sort(function (a, b) { return a.depth - b.depth; });
      items.forEach(function (one) {
        context.strokeStyle = context.fillStyle = colour(one.size / top());
        if (layer.vectors) arrow(one.at, one.end);
        else disc(one.at, Math.max(scale * by * one.size, 1.5));
      });
    }
    scale_bar(width, height);
  }
  function path(points) {
    context.beginPath();
    points.forEach(function (p, i) { if (i) context.lineTo(p[0], p[1]); else context.moveTo(p[0], p[1]); });
  }
  function disc(at, radius) {
    context.beginPath();
    context.arc(at[0], at[1], radius, 0, 2 * Math.PI);
    context.fill();
    context.strokeStyle = GROUND;
    context.lineWidth = 0.6;
    context.stroke();
  }
  function arrow(a, b) {
    var dx = b[0] - a[0], dy = b[1] - a[1], n = Math.hypot(dx, dy);
    disc(a, 1.6);
    context.strokeStyle = context.fillStyle;
    if (n < 1) return;
    var head = Math.min(8, 0.5 * n), ux = dx / n, uy = dy / n;
    context.lineWidth = 1.7;
    path([a, [b[0] - 0.7 * head * ux, b[1] - 0.7 * head * uy]]);
    context.stroke();
    path([b, [b[0] - head * ux - 0.42 * head * uy, b[1] - head * uy + 0.42 * head * ux],
      [b[0] - head * ux + 0.42 * head * uy, b[1] - head * uy - 0.42 * head * ux]]);
    context.fill();
  }
  /* Lines between neighbours: faint where they are nominal, coloured where they are displaced. */
  function grid(items) {
    var by_index = {}, lines = [];
    items.forEach(function (one) { by_index[one.p.index] = one; });
    items.forEach(function (one) {
      [0, 1, 2].forEach(function (axis) {
        var next = one.p.index.slice();
        next[axis] += 1;
        var other = by_index[next];
        if (other) lines.push({ a: one, b: other, depth: one.depth + other.depth });
      });
    });
    lines.sort(function (a, b) { return a.depth - b.depth; });
    context.lineWidth = 0.7;
    context.strokeStyle = FAINT;
    if (state.part !== '') lines.forEach(function (one) { path([one.a.at, one.b.at]); context.stroke(); });
    context.lineWidth = state.part === '' ? 1 : 1.8;
    lines.forEach(function (one) {
      context.strokeStyle = colour(0.5 * (one.a.size + one.b.size) / top());
      path([one.a.end, one.b.end]);
      context.stroke();
    });
  }
  /* The edges of the box, with the letter and the ends of every axis at one edge of it. */
  function box(on, width, room) {
    context.font = FONT;
    context.textBaseline = 'middle';
    context.lineWidth = 0.8;
    var centre = on(middle);
    [0, 1, 2].forEach(function (axis) {
      var others = [0, 1, 2].filter(function (k) { return k !== axis; }), best = null;
      [0, 1, 2, 3].forEach(function (corner) {
        var from = low.slice();
        from[others[0]] = corner & 1 ? high[others[0]] : low[others[0]];
        from[others[1]] = corner & 2 ? high[others[1]] : low[others[1]];
        var to = from.slice();
        to[axis] = high[axis];
        var a = on(from), b = on(to);
        context.strokeStyle = FAINT;
        path([a, b]);
        context.stroke();
        var steep = Math.abs(b[1] - a[1]) > 2 * Math.abs(b[0] - a[0]);
        var rank = steep ? -(a[0] + b[0]) : a[1] + b[1];
        if (best === null || rank > best.rank + 1e-6) best = { a: a, b: b, rank: rank };
      });
      var a = best.a, b = best.b;
      if (Math.hypot(b[0] - a[0], b[1] - a[1]) < 30) return;
      context.strokeStyle = EDGE;
      path([a, b]);
      context.stroke();
      var mx = (a[0] + b[0]) / 2, my = (a[1] + b[1]) / 2;
      var nx = b[1] - a[1], ny = a[0] - b[0], n = Math.hypot(nx, ny);
      if (nx * (mx - centre[0]) + ny * (my - centre[1]) < 0) { nx = -nx; ny = -ny; }
      nx /= n; ny /= n;
      context.fillStyle = INK;
      context.textAlign = nx < -0.5 ? 'right' : nx > 0.5 ? 'left' : 'center';
      [[a, low[axis]], [b, high[axis]]].forEach(function (end) {
        var pull = end[0] === a ? 0.06 : -0.06;
        context.fillText(number(end[1], 4), end[0][0] + pull * (b[0] - a[0]) + 12 * nx,
          end[0][1] + pull * (b[1] - a[1]) + 12 * ny);
      });
      context.fillText(LETTERS[axis] + ', mm', mx + 16 * nx, my + 16 * ny);
    });
  }
  function scale_bar(width, height) {
    var left = 16, wide = Math.min(width - 32, 320), y = height - 34;
    for (var i = 0; i < wide; i += 2) {
      context.fillStyle = colour(i / wide);
      context.fillRect(left + i, y, 2, 10);
    }
    context.font = FONT;
    context.fillStyle = INK;
    context.textBaseline = 'alphabetic';
    [0, 0.5, 1].forEach(function (share) {
      context.textAlign = ['left', 'center', 'right'][2 * share];
      context.fillText(number(share * top()) + (share ? '' : ' \u00b5m'), left + share * wide, y + 24);
    });
  }

  var held = null;
  canvas.addEventListener('pointerdown', function (event) {
    held = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  ['pointerup', 'pointercancel'].forEach(function (name) {
    canvas.addEventListener(name, function () { held = null; });
  });
  canvas.addEventListener('pointermove', function (event) {
    if (held) {
      state.azimuth -= 0.008 * (event.clientX - held[0]);
      tilt(0.008 * (event.clientY - held[1]));
      held = [event.clientX, event.clientY];
      draw();
      return;
    }
    var x = event.offsetX, y = event.offsetY, nearest = null, least = NEAR;
    shown.forEach(function (one) {
      var d = Math.hypot(one.at[0] - x, one.at[1] - y);
      if (d < least) { least = d; nearest = one; }
    });
    reading.textContent = nearest === null ? '' : words(nearest);
  });
  function words(one) {
    var value = state.layer.values[one.i], at = 'At ' + told(one.point.at) + ': ';
    if (value.length < 3) return at + number(value[0]) + ' \u00b5m';
    return at + value.map(function (v, i) { return 'd' + LETTERS[i] + ' ' + number(v); }).join(', ') +
      ' \u00b5m, length ' + number(length(value)) + ' \u00b5m';
  }
  function tilt(by) {
    state.elevation = Math.min(Math.max(state.elevation + by, -Math.PI / 2), Math.PI / 2);
  }
  var keys = {
    ArrowLeft: function () { state.azimuth -= TURN; },
    ArrowRight: function () { state.azimuth += TURN; },
    ArrowUp: function () { tilt(TURN); },
    ArrowDown: function () { tilt(-TURN); },
    Home: first,
    '+': function () { zoom(1.2); },
    '-': function () { zoom(1 / 1.2); }
  };
  canvas.addEventListener('keydown', function (event) {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    keys[event.key]();
    draw();
  });
  adapt();
  draw();
  if (window.ResizeObserver) new ResizeObserver(draw).observe(canvas);
  else window.addEventListener('resize', draw);
}

document.querySelectorAll('figure.scene').forEach(show);
/* Folded tables are printed too, also by browsers in which the style sheet cannot open them. */
var opened = [];
window.addEventListener('beforeprint', function () {
  opened = Array.prototype.slice.call(document.querySelectorAll('details:not([open])'));
  opened.forEach(function (one) { one.open = true; });
});
window.addEventListener('afterprint', function () {
  opened.forEach(function (one) { one.open = false; });
});
})();
