/* Reads rows of (what, time, flag): what 0 is a beat, 1 a question (flag 2: withheld), 2 takes a beat back,
 * 3 changes the field to one whose beat lasts as long as the time says. Writes what came back. */
#include <stdio.h>

#define BEATFIELD_CLOCK_IMPLEMENTATION
#include "beatfield_clock.h"

int main(void)
{
    double head[3], row[3];
    bf_clock clock;
    if (fread(head, sizeof head, 1, stdin) != 1)
        return 1;
    clock = bf_new_clock(head[0], head[1]);
    if (head[2] != 0.14) clock.latency_s = head[2]; /* which it is without being told */
    while (fread(row, sizeof row, 1, stdin) == 1) {
        double out[6] = {0, 0, 0, 0, 0, 0};
        if (row[0] == 0.0) {
            out[0] = (double)bf_beat(&clock, row[1], row[2] > 0.0);
        } else if (row[0] == 2.0) {
            bf_take_back(&clock);
        } else if (row[0] == 3.0) {
            out[0] = bf_change_field(&clock, row[1], 5.0);
        } else {
            bf_tick tick;
            clock.withheld = row[2] > 1.0;
            out[0] = bf_now(&clock, row[1], row[2] > 0.0, &tick);
            out[1] = tick.phase;
            out[2] = tick.sd;
            out[3] = (double)tick.rhythm;
            out[4] = tick.valid;
            out[5] = tick.fade;
        }
        fwrite(out, sizeof out, 1, stdout);
    }
    return 0;
}
