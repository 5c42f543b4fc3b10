/* What the tests of beatfield.h drive: questions from standard input, answers to standard output,
 * all as doubles. */
#define BEATFIELD_IMPLEMENTATION
#include "beatfield.h"
#include <locale.h>

/* FIELD: x y z phase -> per fixture force, distance, gradient, potential */
static int ask(const bf_field *field)
{
    double q[4], answer[8];
    int n;
    while (fread(q, sizeof(double), 4, stdin) == 4)
        for (n = 0; n < field->fixtures; n++) {
            if (bf_force(field, n, q, q[3], answer) != BF_OK ||
                bf_distance(field, field->fixture[n].structure, q, q[3], answer + 3, answer + 4) != BF_OK ||
                bf_potential(field, n, q, q[3], answer + 7) != BF_OK)
                return 1;
            fwrite(answer, sizeof(double), 8, stdout);
        }
    return 0;
}

/* FIELD contains: points -> 1 or 0 */
static int contains(const bf_field *field)
{
    double q[3], answer;
    while (fread(q, sizeof(double), 3, stdin) == 3) {
        answer = bf_contains(field, q);
        fwrite(&answer, sizeof(double), 1, stdout);
    }
    return 0;
}

/* FIELD tool BOUND COUNT CLOSED: the tool's points first, then a transform and a phase each ->
 * force, torque and evaluations */
static int feel(const bf_field *field, double bound_n, int count, int closed)
{
    double *points = (double *)malloc((size_t)count * 3 * sizeof(double)), q[17], answer[7];
    bf_tool tool;
    int n, evaluations, failed = !points || fread(points, sizeof(double), (size_t)count * 3, stdin) == 0;
    tool.points_mm = points;
    tool.count = count;
    tool.closed = closed;
    tool.handle_mm[0] = tool.handle_mm[1] = 0;
    tool.handle_mm[2] = 100;
    while (!failed && fread(q, sizeof(double), 17, stdin) == 17)
        for (n = 0; n < field->fixtures; n++) {
            failed |= bf_tool_force(field, n, &tool, q, q[16], bound_n, answer, answer + 3,
                                    &evaluations) != BF_OK;
            answer[6] = evaluations;
            fwrite(answer, sizeof(double), 7, stdout);
        }
    free(points);
    return failed;
}

/* FIELD tank LEVEL CAPACITY: point and wanted force -> rendered force and level */
static int tank(double level_mj, double capacity_mj)
{
    double q[6];
    bf_tank held = bf_full_tank(level_mj, capacity_mj);
    while (fread(q, sizeof(double), 6, stdin) == 6) {
        bf_pass(&held, q, q + 3);
        fwrite(q + 3, sizeof(double), 3, stdout);
        fwrite(&held.level_mj, sizeof(double), 1, stdout);
    }
    return 0;
}

/* Whether numbers that a server might use by mistake are zeros; then they are made stale again. */
static int nothing(double *numbers, size_t count)
{
    int none = 1;
    for (; count; numbers[--count] = 9) none &= numbers[count - 1] == 0;
    return none;
}

static int refuse(const bf_field *field)
{
    double point[3] = {0, 0, 0}, bad[3] = {0, NAN, 0}, answer[12], phases[2] = {0, 0};
    double *force = answer, *rest = answer + 3;
    nothing(answer, 12);
    return !(bf_force(field, -1, point, 0, force) == BF_NO_SUCH_NAME && nothing(force, 3) &&
             bf_force(field, field->fixtures, point, 0, force) == BF_NO_SUCH_NAME &&
             nothing(force, 3) &&
             bf_force(field, 0, bad, 0, force) == BF_NOT_FINITE && nothing(force, 3) &&
             bf_force(field, 0, point, INFINITY, force) == BF_NOT_FINITE && nothing(force, 3) &&
             bf_distance(field, 99, point, 0, force, rest) == BF_NO_SUCH_NAME &&
             nothing(force, 1) && nothing(rest, 3) &&
             bf_distance(field, 0, bad, 0, force, NULL) == BF_NOT_FINITE && nothing(force, 1) &&
             bf_potential(field, 0, bad, 0, force) == BF_NOT_FINITE && nothing(force, 1) &&
             bf_potential(field, -1, point, 0, force) == BF_NO_SUCH_NAME && nothing(force, 1) &&
             bf_forces(field, 0, 1, point, phases, 2, force, NULL) == BF_WRONG_SIZE &&
             nothing(force, 3) &&
             bf_distances(field, 0, 1, bad, phases, 1, force, rest, NULL) == BF_NOT_FINITE &&
             nothing(force, 1) && nothing(rest, 3) &&
             bf_structure(field, "none") == -1 && bf_fixture(field, "") == -1);
}

/* Whether a tool's question has a status, and where that is a failure no force, torque or count. */
static int felt(const bf_field *field, const bf_tool *tool, const double *pose, double phase,
                double bound_n, bf_status wanted)
{
    double answer[6];
    int evaluations = 9, none;
    bf_status status;
    nothing(answer, 6);
    status = bf_tool_force(field, 0, tool, pose, phase, bound_n, answer, answer + 3, &evaluations);
    none = nothing(answer, 6) && evaluations == 0;
    return status == wanted && (status == BF_OK || none);
}

static int refuse_tools(const bf_field *field)
{
    double line[6] = {0, 0, 0, 0, 0, 9};
    double pose[16] = {1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1};
    double by_columns[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1};
    double turned[16] = {0.6, -0.8, 0, 5, 0.8, 0.6, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1};
    bf_tool needle = {NULL, 2, 0, {0, 0, 0}}, none = {NULL, 0, 0, {0, 0, 0}}, strange, far, point;
    int fine;
    needle.points_mm = line;
    strange = far = point = needle;
    strange.handle_mm[1] = NAN;
    far.handle_mm[0] = 1.7e308;
    far.handle_mm[1] = -1.7e308;
    point.points_mm = line + 3;
    point.count = 1;
    fine = felt(field, &needle, pose, 0, 0.1, BF_OK) && felt(field, &point, pose, 0, 0.1, BF_OK) &&
           felt(field, &none, pose, 0, 0.1, BF_WRONG_SIZE) &&
           felt(field, &needle, pose, 0, 0, BF_WRONG_BOUND) &&
           felt(field, &needle, pose, 0, -1, BF_WRONG_BOUND) &&
           felt(field, &needle, pose, 0, NAN, BF_WRONG_BOUND) &&
           felt(field, &needle, pose, INFINITY, 0.1, BF_NOT_FINITE) &&
           felt(field, &strange, pose, 0, 0.1, BF_NOT_FINITE) &&
           felt(field, &far, turned, 0, 0.1, BF_NOT_FINITE) &&
           felt(field, &needle, turned, 0, 0.1, BF_OK) &&
           felt(field, &needle, by_columns, 0, 0.1, BF_NOT_RIGID);
    line[4] = NAN;
    fine = fine && felt(field, &needle, pose, 0, 0.1, BF_NOT_FINITE) &&
           felt(field, &point, pose, 0, 0.1, BF_NOT_FINITE);
    pose[3] = NAN;
    return !(fine && felt(field, &needle, pose, 0, 0.1, BF_NOT_FINITE));
}

/* FIELD poses: transforms -> the status of a tool there */
static int poses(const bf_field *field)
{
    const double line[6] = {0, 0, 0, 0, 0, 9};
    bf_tool needle = {NULL, 2, 0, {0, 0, 0}};
    double q[16], force[3], answer;
    needle.points_mm = line;
    while (fread(q, sizeof(double), 16, stdin) == 16) {
        answer = bf_tool_force(field, 0, &needle, q, 0, 0.1, force, NULL, NULL);
        fwrite(&answer, sizeof(double), 1, stdout);
    }
    return 0;
}

/* FIELD damaged, and a question (x, y, z, phase) whose answer a damaged value spoils: whether every
 * function says so and gives zeros, and a structure that is not damaged answers as ever. */
static int damaged(const bf_field *field)
{
    enum { MANY = 2048 };
    static double points[3 * MANY], phases[MANY], answers[4 * MANY], scratch[BF_SCRATCH * MANY];
    const double line[6] = {-20, 0, 0, 20, 0, 0};
    double q[4], pose[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    bf_tool needle = {NULL, 2, 0, {0, 0, 0}};
    int n, fine = fread(q, sizeof(double), 4, stdin) == 4;
    needle.points_mm = line;
    for (n = 0; n < 3; n++) pose[4 * n + 3] = q[n];
    nothing(answers, 4 * MANY);
    for (n = 0; n < 2; n++)
        fine = fine && field->fixture[n].structure == 0 &&
               bf_force(field, n, q, q[3], answers) == BF_DAMAGED && nothing(answers, 3) &&
               bf_potential(field, n, q, q[3], answers) == BF_DAMAGED && nothing(answers, 1);
    fine = fine && bf_distance(field, 0, q, q[3], answers, answers + 1) == BF_DAMAGED &&
           nothing(answers, 4) && bf_distance(field, 0, q, q[3], NULL, NULL) == BF_DAMAGED &&
           felt(field, &needle, pose, q[3], 0.05, BF_DAMAGED) &&
           bf_force(field, 2, q, q[3], answers) == BF_OK;
    /* Far from one another, so that scratch room is used; the damage is met in the middle. */
    for (n = 0; n < MANY; n++) {
        points[3 * n + n % 3] = n % 2 ? 30 : -30;
        phases[n] = n / 7.0;
    }
    memcpy(points + MANY / 2 * 3, q, 3 * sizeof(double));
    phases[MANY / 2] = q[3];
    nothing(answers, 4 * MANY);
    scratch[0] = 7;
    for (n = 0; n < 2; n++) {
        double *room = n ? scratch : NULL;
        fine = fine &&
               bf_forces(field, 0, MANY, points, phases, MANY, answers, room) == BF_DAMAGED &&
               nothing(answers, 3 * MANY) &&
               bf_distances(field, 0, MANY, points, phases, MANY, answers, answers + MANY, room) ==
                   BF_DAMAGED &&
               nothing(answers, 4 * MANY) &&
               bf_forces(field, 2, MANY, points, phases, MANY, answers, room) == BF_OK;
        nothing(answers, 4 * MANY);
    }
    return !(fine && scratch[0] != 7);
}

int main(int count, char **words)
{
    bf_field field;
    bf_status status;
    int failed = 0;
    /* A comma for a decimal point in the user's locale must not matter. */
    setlocale(LC_ALL, "");
    if (count > 2 && strcmp(words[2], "verify") == 0) {
        status = bf_verify(words[1]);
        printf("%s\n", bf_text(status));
        return (int)status;
    }
    status = bf_open(&field, words[1]);
    if (status != BF_OK) {
        printf("%s\n", bf_text(status));
        return (int)status;
    }
    if (count > 5) failed = feel(&field, atof(words[3]), atoi(words[4]), atoi(words[5]));
    else if (count > 4) failed = tank(atof(words[3]), atof(words[4]));
    else if (count > 2 && strcmp(words[2], "refuse") == 0)
        failed = refuse(&field) || refuse_tools(&field);
    else if (count > 2 && strcmp(words[2], "poses") == 0) failed = poses(&field);
    else if (count > 2 && strcmp(words[2], "damaged") == 0) failed = damaged(&field);
    else if (count > 2 && strcmp(words[2], "lock") == 0) failed = bf_lock(&field) == BF_DAMAGED;
    else if (count > 2 && strcmp(words[2], "contains") == 0) failed = contains(&field);
    else failed = ask(&field);
    bf_close(&field);
    bf_close(&field);
    return failed ? 100 : 0;
}
