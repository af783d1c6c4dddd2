/* A worker, for one answer: graphicsOf a canvas of its own; null also where a worker has no canvas. */
import { graphicsOf } from './graphics.js'

postMessage(typeof OffscreenCanvas === 'undefined' ? null : graphicsOf(new OffscreenCanvas(1, 1)))
