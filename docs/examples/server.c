/* A force server: R peaks in, the heart's phase now, the force on a tool out.
 *
 *     beatfield rpeaks STUDY/ecg/us --out peaks.csv
 *     cc -O2 -I "$(python -c 'from pipeline.field import get_include; print(get_include())')" \
 *        docs/examples/server.c -o server -lm
 *     ./server OUT/patient-0001/bake/field.zarr peaks.csv X Y Z > forces.csv
 *
 * plays the peaks when they became known and holds the tool's tip at one point of the MR, in LPS
 * millimetres. A real server does the same with the peaks of its monitor, timed by the clock of its own
 * loop; with a tip that bf_transform(field.mr_from_tracker, ...) takes from the tracker's frame to
 * that of the MR, where field.registered; and turns the force back by bf_turn_back for its device.
 */
#define BEATFIELD_IMPLEMENTATION
#define BEATFIELD_CLOCK_IMPLEMENTATION
#include "beatfield.h"
#include "beatfield_clock.h"

#define RATE_HZ 1000
#define USUAL_RR_S 0.8          /* of a field that does not know the length of its heartbeat */
#define FORCE_RATE_N_PER_S 10.0 /* how fast forces are faded in and out */

typedef struct {
    double r_s, known_s;
    int strange;
} peak;

/* A word that is a number and nothing else; not a number (which the field refuses) otherwise. */
static double number(const char *word)
{
    char *end;
    double value = strtod(word, &end);
    return end > word && !*end ? value : (double)NAN;
}

/* The table of peaks, row by row. */
typedef struct {
    FILE *file;
    const char *path;
    long line;  /* number of the one read last */
    int broken; /* it was no row of the table, which has been told */
} peak_table;

/* Whether a line is a whole row, and what it says. */
static int is_peak(char *line, peak *found)
{
    static const char *const kinds[] = {"normal", "ectopic", "irregular"};
    char *kind = strchr(line, ','), *strange, *known_s, *at;
    int commas = 0, known = 0, n;
    for (at = line; *at; at++) commas += *at == ',';
    if (commas < 7) return 0;
    /* Counted from the end, for the name of a lead may hold commas. */
    strange = strrchr(line, ',');
    *strange++ = 0;
    strange[strcspn(strange, "\r\n")] = 0;
    known_s = strrchr(line, ',') + 1;
    *kind++ = 0;
    kind[strcspn(kind, ",")] = 0;
    for (n = 0; n < 3; n++) known = known || !strcmp(kind, kinds[n]);
    found->r_s = number(line);
    found->strange = !strcmp(strange, "1");
    found->known_s = number(known_s);
    known = known && (found->strange || !strcmp(strange, "0"));
    return known && isfinite(found->r_s) && isfinite(found->known_s) && found->known_s >= found->r_s;
}

/* The next row of `beatfield rpeaks`; 0 at the end of the file, and where a row is broken. */
static int next_peak(peak_table *table, peak *found)
{
    char line[256];
    if (table->broken || !fgets(line, sizeof line, table->file)) return 0;
    table->line++;
    if (is_peak(line, found)) return 1;
    table->broken = 1;
    fprintf(stderr,
            "error: %s, line %ld: is no row of `beatfield rpeaks`: it needs eight columns, the "
            "first the R time in seconds, the second normal, ectopic or irregular, the last two when "
            "the beat was known, at its R time or later, and 1 if its shape is unlike the others', "
            "or 0; write the table again\n",
            table->path, table->line);
    return 0;
}

/* A row a millisecond, from the moment at which the first peak is known to that of the last. */
static bf_status serve(const bf_field *field, peak_table *peaks, const double tip_mm[3])
{
    const double fade_per_s = FORCE_RATE_N_PER_S / field->fixture[0].f_max_n;
    bf_clock clock = bf_new_clock(field->rr_s > 0 ? field->rr_s : USUAL_RR_S, fade_per_s);
    bf_status status = BF_OK;
    bf_tick now;
    peak next;
    double force_n[3];
    int more = next_peak(peaks, &next);
    int lead_connected = 1; /* a monitor tells it; a table of peaks cannot */
    long turn = more ? (long)ceil(next.known_s * RATE_HZ) : 0;
    for (; more && status == BF_OK; turn++) {
        double time_s = (double)turn / RATE_HZ;
        /* Times in the file are rounded to 10 us. */
        while (more && next.known_s <= time_s + 1e-5) {
            bf_beat(&clock, next.r_s, next.strange);
            more = next_peak(peaks, &next);
        }
        clock.withheld = !bf_contains(field, tip_mm);
        bf_now(&clock, time_s, lead_connected, &now);
        status = bf_force(field, 0, tip_mm, now.phase, force_n);
        /* Fading is all that a lost lead, an early beat, fibrillation or a tip that leaves the grid
         * asks of a server. */
        printf("%.3f,%.6f,%d,%.6f,%.6f,%.6f,%.6f\n", time_s, now.phase, now.valid, now.fade,
               now.fade * force_n[0], now.fade * force_n[1], now.fade * force_n[2]);
    }
    return status;
}

int main(int count, char **words)
{
    bf_field field;
    bf_status status;
    peak_table peaks = {NULL, NULL, 1, 0};
    char header[256];
    double tip_mm[3];
    int n;
    if (count != 6) {
        fprintf(stderr, "use: %s FIELD PEAKS X Y Z (LPS mm)\n", words[0]);
        return 2;
    }
    for (n = 0; n < 3; n++) tip_mm[n] = number(words[3 + n]);
    peaks.path = words[2];
    peaks.file = fopen(words[2], "r");
    if (!peaks.file || !fgets(header, sizeof header, peaks.file) ||
        strncmp(header, "time_s,kind,", 12)) {
        fprintf(stderr, "error: %s: is no table that `beatfield rpeaks` wrote\n", words[2]);
        if (peaks.file) fclose(peaks.file);
        return 2;
    }
    status = bf_verify(words[1]); /* every byte, before any of it is felt */
    if (status == BF_OK) status = bf_open(&field, words[1]);
    if (status == BF_OK && !bf_contains(&field, tip_mm)) {
        fprintf(stderr, "error: %s: its grid does not hold the point; give one near the heart\n", words[1]);
        bf_close(&field);
        fclose(peaks.file);
        return 2;
    }
    if (status == BF_OK) {
        /* Values in memory before the loop starts, whether they may be locked there or not. */
        status = bf_lock(&field);
        if (status == BF_CANNOT_LOCK) status = BF_OK;
        if (status == BF_OK && field.doubts > 0)
            fprintf(stderr, "note: %d things speak against %s; `beatfield verify` prints them\n", field.doubts,
                    words[1]);
        if (status == BF_OK) printf("time_s,phase,valid,fade,x_n,y_n,z_n\n");
        if (status == BF_OK) status = serve(&field, &peaks, tip_mm);
        bf_close(&field);
    }
    fclose(peaks.file);
    if (status != BF_OK) fprintf(stderr, "error: %s: %s\n", words[1], bf_text(status));
    return status == BF_OK && !peaks.broken ? 0 : 2;
}
