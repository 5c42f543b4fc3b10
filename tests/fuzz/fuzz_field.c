/* Fuzz what beatfield.h reads from a store: its description, its manifest, and questions to it.
 *
 *     clang -g -O1 -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all \
 *         -I pipeline/field/include tests/fuzz/fuzz_field.c -o fuzz_field -lm
 *     mkdir -p corpus && export BF_FUZZ_FOLDER="$(python tests/fuzz/seeds.py corpus)"
 *     ./fuzz_field corpus -dict=tests/fuzz/field.dict -max_len=8192 -max_total_time=900
 *
 * The first byte of an input chooses what it is: 0 a description as text; 1 a manifest beside a
 * good description, in a folder that bf_open and bf_verify read; 2 a description in that folder,
 * sealed with a manifest that fits it, so that bf_open goes on to the chunk files; 3 a grid and
 * questions to it as raw doubles. BF_FUZZ_FOLDER names the store to damage (seeds.py writes one).
 */
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"

static char folder[512];
static char *good;
static size_t good_length;

int LLVMFuzzerInitialize(int *count, char ***words);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(int fine, const char *what)
{
    if (fine) return;
    fprintf(stderr, "%s\n", what);
    abort();
}

int LLVMFuzzerInitialize(int *count, char ***words)
{
    const char *given = getenv("BF_FUZZ_FOLDER");
    bf__folder entered;
    (void)count;
    (void)words;
    must(given && strlen(given) < sizeof folder, "BF_FUZZ_FOLDER must name a store to damage");
    strcpy(folder, given);
    must(bf__enter(&entered, given) == BF_OK, "cannot enter BF_FUZZ_FOLDER");
    must(bf__read(&entered, "good.json", &good, &good_length) == BF_OK, "no good.json in it");
    bf__leave(&entered);
    return 0;
}

static void put(const char *name, const void *content, size_t length)
{
    char path[sizeof folder + 64];
    FILE *file;
    snprintf(path, sizeof path, "%s/%s", folder, name);
    file = fopen(path, "wb");
    must(file && fwrite(content, 1, length, file) == length, "cannot write to the store");
    fclose(file);
}

/* A manifest that fits the description alone: what bf_open compares. */
static void seal(const void *text, size_t length)
{
    char sha256[65], manifest[256];
    bf__sha sha;
    bf__sha_start(&sha);
    bf__sha_add(&sha, text, length);
    bf__sha_end(&sha, sha256);
    snprintf(manifest, sizeof manifest,
             "{\"files\": {\"zarr.json\": {\"size\": %lu, \"sha256\": \"%s\"}}}",
             (unsigned long)length, sha256);
    put("zarr.json", text, length);
    put("manifest.json", manifest, strlen(manifest));
}

/* A few questions in the way that a batch sorts many. */
static void sort(const bf_field *field, int fixture, const double *q)
{
    enum { SOME = 9 };
    double points[3 * SOME], phases[SOME], answers[4 * SOME], scratch[BF_SCRATCH * SOME];
    bf__batch batch;
    int n;
    for (n = 0; n < SOME; n++) {
        memcpy(points + 3 * n, q + n % 7, 3 * sizeof(double));
        phases[n] = q[n];
    }
    if (bf__askable(SOME, points, phases, SOME) != BF_OK) return;
    memset(&batch, 0, sizeof batch);
    batch.field = field;
    batch.structure = field->fixture[fixture].structure;
    batch.count = SOME;
    batch.points_mm = points;
    batch.phases = phases;
    batch.many_phases = 1;
    batch.first = answers;
    batch.rest = answers + SOME;
    bf__answer_sorted(&batch, scratch);
    batch.law = &field->fixture[fixture];
    bf__answer_sorted(&batch, scratch);
}

static void ask(const bf_field *field, const double *q)
{
    double answer[6], torque[3], line[9], distance[2];
    double pose[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    bf_tool tool;
    int n;
    memcpy(line, q, sizeof line);
    tool.points_mm = line;
    tool.count = 3;
    tool.closed = q[3] > 0;
    memcpy(tool.handle_mm, q + 6, sizeof tool.handle_mm);
    for (n = 0; n < field->fixtures && n < 4; n++) {
        bf_force(field, n, q, q[3], answer);
        bf_potential(field, n, q + 1, q[4], answer);
        bf_forces(field, n, 2, q, q + 6, 2, answer, NULL);
        bf_distances(field, field->fixture[n].structure, 2, q, q + 6, 2, distance, answer, NULL);
        sort(field, n, q);
        /* A tool of any length is asked up to a million times: only short ones here. */
        if (fabs(q[0]) + fabs(q[1]) + fabs(q[2]) + fabs(q[3]) + fabs(q[4]) + fabs(q[5]) < 50 &&
            fabs(q[6]) + fabs(q[7]) + fabs(q[8]) < 50 && field->spacing_mm[0] > 0.5 &&
            field->spacing_mm[1] > 0.5 && field->spacing_mm[2] > 0.5)
            bf_tool_force(field, n, &tool, pose, q[5], 0.5, answer, torque, NULL);
    }
}

/* Coefficients of its own for a description that was understood without a store. */
static void ask_described(bf_field *field)
{
    static const double questions[9] = {1, -2, 3, 0.1, 0.99, 12, -7, 5, -0.3};
    int n, k;
    float *values;
    if (field->bytes > 65536 || field->phases > 64 || field->structures > 8) return;
    values = (float *)calloc(1, field->bytes);
    must(values != NULL, "no memory");
    for (n = 0; n < field->structures; n++) {
        field->structure[n].coefficients = (const float **)calloc((size_t)field->phases, sizeof(float *));
        for (k = 0; k < field->phases; k++) field->structure[n].coefficients[k] = values;
    }
    ask(field, questions);
    for (n = 0; n < field->structures; n++) {
        free((void *)field->structure[n].coefficients);
        field->structure[n].coefficients = NULL;
    }
    free(values);
}

/* Nine doubles are the questions; six more are a grid's origin and spacing. */
static void questions(const uint8_t *data, size_t size)
{
    double q[15], *phase;
    float values[5 * 4 * 3];
    bf_field field;
    int n;
    if (size < sizeof q) return;
    memcpy(q, data, sizeof q);
    must(bf_describe(&field, good, good_length) == BF_OK, "the good description is refused");
    field.shape[0] = 5;
    field.shape[1] = 4;
    field.shape[2] = 3;
    memcpy(field.origin_mm, q + 9, sizeof field.origin_mm);
    for (n = 0; n < 3; n++) {
        /* What bf_describe lets pass. */
        if (!(fabs(field.origin_mm[n]) < 1e9)) field.origin_mm[n] = 0;
        field.spacing_mm[n] = q[12 + n] > 1e-6 && q[12 + n] < 1e6 ? q[12 + n] : 1;
    }
    bf__scale(&field);
    for (n = 0; n < 60; n++) values[n] = (float)(n % 7 - 3);
    phase = field.phase;
    for (n = 0; n < field.structures; n++) {
        int k;
        field.structure[n].coefficients = (const float **)calloc((size_t)field.phases, sizeof(float *));
        for (k = 0; k < field.phases; k++) {
            /* Its own array a phase, so that a step over an end is seen. */
            float *own = (float *)malloc(sizeof values);
            must(own && phase, "no memory");
            memcpy(own, values, sizeof values);
            field.structure[n].coefficients[k] = own;
        }
    }
    ask(&field, q);
    for (n = 0; n < field.structures; n++) {
        int k;
        for (k = 0; k < field.phases; k++) free((void *)field.structure[n].coefficients[k]);
        free((void *)field.structure[n].coefficients);
        field.structure[n].coefficients = NULL;
    }
    bf_close(&field);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const double points[9] = {10, 5, 3, 0.4, -0.2, 1.7, 30, -40, 50};
    const char *text = (const char *)data + 1;
    bf_field field;
    if (size < 1) return 0;
    size--;
    switch (data[0] & 3) {
    case 0:
        if (bf_describe(&field, text, size) == BF_OK) ask_described(&field);
        bf_close(&field);
        break;
    case 1:
        put("zarr.json", good, good_length);
        put("manifest.json", text, size);
        if (bf_open(&field, folder) == BF_OK) ask(&field, points);
        bf_close(&field);
        bf_verify(folder);
        break;
    case 2:
        seal(text, size);
        if (bf_open(&field, folder) == BF_OK) ask(&field, points);
        bf_close(&field);
        break;
    default: questions(data + 1, size);
    }
    return 0;
}
