// Time series charts with a shared cursor. It draws samples and sends no requests.

import { html } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { change } from '../../display/display.js';
import { minute } from '../../display/format.js';

const HEIGHT = 128;
const FONT = '12px system-ui, sans-serif';
// Longer gaps between samples break the line; about one sample per minute arrives.
const GAP_MS = 150_000;
// The steps between the lines of an axis in bytes.
const POWERS_OF_TWO = Array.from({ length: 53 }, (_, power) => 2 ** power);
const scheme = matchMedia('(prefers-color-scheme: dark)');

/**
 * Draws a chart for each of `figures`, `{ id, title, most(samples), tick(value), isBytes, lines:
 * [{ title, of(sample) }] }`.
 */
export class Charts {
  /** The sample under the pointer. */
  pointed = null;
  #figures;
  #key = `charts-${Math.random()}`;
  #charts = new Map();
  #points = [];
  #window = [0, 1];
  #colours = {};
  #observer = new ResizeObserver((entries) =>
    entries.forEach(({ target, contentRect }) => this.#resize(target, contentRect.width)),
  );
  /** Recreates the charts in the current colours. */
  #recolour = () => {
    this.#colours = coloursNow();
    this.#destroyCharts();
    change();
  };

  constructor(figures) {
    this.#figures = figures;
    this.#recolour();
    scheme.addEventListener('change', this.#recolour);
  }

  /** Destroys the charts. */
  leave() {
    scheme.removeEventListener('change', this.#recolour);
    this.#destroyCharts();
  }

  #destroyCharts() {
    this.#observer.disconnect();
    for (const { chart } of this.#charts.values()) chart.destroy();
    this.#charts.clear();
  }

  /**
   * The container of a chart. It is hidden from screen readers, since the text beside it has the
   * same values.
   */
  place = ({ id }) => html`<div class="curves" data-figure=${id} aria-hidden="true"></div>`;

  /** Shows samples, oldest first, in this time range. */
  show(samples, from, to) {
    this.#window = [from / 1000, to / 1000];
    this.#points = withGaps(samples);
    for (const { id } of this.#figures) this.#charts.get(id)?.chart.setData(this.#dataOf(id));
  }

  /** Creates charts in new containers. Call this after each drawing. */
  async attach() {
    const places = [...document.querySelectorAll('.curves')].filter(
      (place) => this.#charts.get(place.dataset.figure)?.place !== place,
    );
    if (!places.length) return;
    // The chart library is loaded on first use.
    const { default: UPlot } = await import('../../vendor/uplot-1.6.32/uPlot.esm.js');
    for (const place of places) if (place.isConnected) this.#put(UPlot, place);
  }

  #put(UPlot, place) {
    const { figure: id } = place.dataset;
    const old = this.#charts.get(id);
    if (old?.place === place) return;
    if (old) {
      this.#observer.unobserve(old.place);
      old.chart.destroy();
    }
    const chart = new UPlot(
      this.#options(
        this.#figures.find((figure) => figure.id === id),
        place.clientWidth,
      ),
      this.#dataOf(id),
      place,
    );
    this.#charts.set(id, { place, chart });
    this.#observer.observe(place);
  }

  #resize(place, width) {
    const { chart } = this.#charts.get(place.dataset.figure) ?? {};
    if (chart && width && Math.round(width) !== chart.width)
      chart.setSize({ width: Math.round(width), height: HEIGHT });
  }

  #dataOf(id) {
    const { lines } = this.#figures.find((figure) => figure.id === id);
    return [
      this.#points.map(({ at_ms: then }) => then / 1000),
      ...lines.map(({ of }) =>
        this.#points.map((point) => (point.isGap ? null : (of(point) ?? null))),
      ),
    ];
  }

  #options({ most, tick, isBytes, lines }, width) {
    const colour = (name) => () => this.#colours[name];
    const axis = { stroke: colour('--quiet'), font: FONT, ticks: { show: false }, gap: 6 };
    const strokes = ['--accent', '--quiet'];
    return {
      width,
      height: HEIGHT,
      padding: [8, 8, 0, 0],
      legend: { show: false },
      cursor: {
        sync: { key: this.#key },
        y: false,
        drag: { x: false, y: false },
        points: { size: 7, width: 0, fill: (_, line) => this.#colours[strokes[line - 1]] },
      },
      scales: {
        x: { time: true, range: () => this.#window },
        y: { range: (_, __, highest) => [0, most(this.#points, highest)] },
      },
      axes: [
        {
          ...axis,
          size: 24,
          space: 72,
          grid: { show: false },
          values: (_, moments) => moments.map((s) => minute(s * 1000)),
        },
        {
          ...axis,
          size: 68,
          space: 30,
          grid: { stroke: colour('--hair'), width: 1 },
          values: (_, values) => values.map((value) => (this.#points.length ? tick(value) : '')),
          ...(isBytes && { incrs: POWERS_OF_TWO }),
        },
      ],
      series: [
        {},
        ...lines.map((_, line) => ({
          stroke: colour(strokes[line]),
          width: 1.5,
          dash: line ? [4, 3] : [],
          fill: line ? null : colour('--accent-wash'),
          points: { show: false },
        })),
      ],
      hooks: { setCursor: [({ cursor: { idx: index } }) => this.#point(index)] },
    };
  }

  #point(index) {
    const point = this.#points[index];
    const pointed = point && !point.isGap ? point : null;
    if (pointed !== this.pointed) change(() => (this.pointed = pointed));
  }
}

/** The samples, with gaps marked. */
function withGaps(samples) {
  return samples.flatMap((sample, index) => {
    const before = samples[index - 1]?.at_ms;
    return before && sample.at_ms - before > GAP_MS
      ? [{ at_ms: before + 1, isGap: true }, sample]
      : [sample];
  });
}

/** A canvas cannot use CSS variables, so their values are read from an element. */
function coloursNow() {
  const probe = document.createElement('span');
  document.body.append(probe);
  const of = (name) => {
    probe.style.color = `var(${name})`;
    return getComputedStyle(probe).color;
  };
  const colours = Object.fromEntries(
    ['--accent', '--accent-wash', '--quiet', '--hair'].map((name) => [name, of(name)]),
  );
  probe.remove();
  return colours;
}
