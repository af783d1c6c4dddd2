#ifndef CBCT_CORE_PULSE_H
#define CBCT_CORE_PULSE_H

#ifdef __cplusplus
extern "C" {
#endif

/*
 * Work counts its steps here: a block of a projection, a tile of voxels, a question whether to go on. A thread beside
 * it can tell work from standing still by that, whatever the work is. One counter a process, since a process works on
 * one reconstruction at a time. Any thread.
 */
void pulse_beat(void);
unsigned long pulse_count(void);

#ifdef __cplusplus
}
#endif

#endif
