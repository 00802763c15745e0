/* A robot that drives round a square, in C: joins a map, inserts, follows the estimate. Written from proto/README.md.
 *
 *     ./robot HOST PORT MAP
 */
#define _POSIX_C_SOURCE 200809L
#include "messagepack.h"
#include "versions.h"
#include "zenoh.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* Nanoseconds of a variable without a time stamp, §4. */
#define NO_STAMP INT64_MIN

enum { POSES = 5, TRY_MS = 10000, TRIES = 20, FIRST_PAUSE_MS = 100, LONGEST_PAUSE_MS = 1000, PATIENCE_MS = 10000,
       SILENCES = 3 /* in a row, 0.3 s, are worth a look for services of other versions */ };

static const double SIDE[3] = {1.0, 0.02, 1.55}, HOME[3] = {0.0, 0.0, 0.0};
/* Upper triangles: 5 cm and 0.03 rad; 1 cm and 0.01 rad. */
static const double ODOMETRY[6] = {400, 0, 0, 400, 0, 1111.1111111111111}, CLOSURE[6] = {1e4, 0, 0, 1e4, 0, 1e4};

/* Poses as they are at `revision` of `epoch`, §7. */
typedef struct {
    uint64_t epoch, revision;
    bool known[POSES], gap, live;
    double poses[POSES][3];
    int64_t stamps[POSES];
} estimate;

typedef struct {
    z_session *bus;
    char map[65], name[16];
    uint64_t epoch, sequence;
    bool heard; /* a service has answered: whatever else is there, it may come back */
    estimate now;
} robot;

static int64_t key_of(char letter, int64_t index) { return (int64_t)letter << 56 | index; }

static uint64_t whole(const mp_value *message, const char *name)
{
    const mp_value *field = mp_field(message, name);
    return field == NULL ? 0 : field->type == MP_UINT ? field->unsigned_integer : (uint64_t)field->integer;
}

/* ---- following, §7 ---- */

/* Values of the groups of se2; other kinds are skipped, as are keys that are not ours. */
static void apply(estimate *now, const mp_value *message)
{
    const mp_value *groups = mp_field(message, "variables");
    for (uint32_t i = 0; groups != NULL && i < groups->count; i++) {
        const mp_value *keys = mp_field(&groups->children[i], "keys"), *values = mp_field(&groups->children[i], "values");
        const mp_value *stamps = mp_field(&groups->children[i], "stamps");
        if (!mp_is(mp_field(&groups->children[i], "kind"), "se2") || keys == NULL || values == NULL) continue;
        if (values->size != 3 * keys->size) continue;
        if (stamps != NULL && stamps->size != keys->size) continue;
        for (size_t k = 0; k < keys->size / 8; k++) {
            int64_t index = mp_i64_at(keys, k) - key_of('x', 0);
            if (index < 0 || index >= POSES) continue;
            now->known[index] = true;
            for (size_t c = 0; c < 3; c++) now->poses[index][c] = mp_f64_at(values, 3 * k + c);
            now->stamps[index] = stamps != NULL ? mp_i64_at(stamps, k) : NO_STAMP;
        }
    }
    now->epoch = whole(message, "epoch");
    now->revision = whole(message, "revision");
}

static void on_delta(void *context, const char *key, const uint8_t *payload, size_t size)
{
    (void)key;
    estimate *now = context;
    mp_value *delta = mp_read(payload, size);
    uint64_t previous = whole(delta, "previous"), revision = whole(delta, "revision");
    bool other = delta == NULL || whole(delta, "epoch") != now->epoch;
    if (previous == 0 && delta != NULL) {
        memset(now->known, 0, sizeof now->known); /* it holds the whole estimate */
        apply(now, delta);
        now->live = true;
        now->gap = false;
    } else if (other || !now->live || previous > now->revision) {
        now->gap = true; /* something is missing: the whole estimate again */
    } else if (revision > now->revision) {
        apply(now, delta);
    }
    mp_release(delta);
}

/* ---- asking ---- */

static void complain(const char *what, const z_answer *answer)
{
    mp_value *problem = answer->outcome == Z_ERROR ? mp_read(answer->payload, answer->size) : NULL;
    const mp_value *code = mp_field(problem, "code"), *message = mp_field(problem, "message");
    if (code != NULL && message != NULL)
        fprintf(stderr, "%s: %.*s [%.*s]\n", what, (int)message->size, (const char *)message->bytes, (int)code->size,
                (const char *)code->bytes);
    else fprintf(stderr, "%s: %s\n", what, answer->outcome == Z_BROKEN ? "the connection is gone" : "no answer");
    mp_release(problem);
}

/* Whether the same bytes are to be sent again, §6, and after how long. */
static bool again(const z_answer *answer, int *pause_ms)
{
    if (answer->outcome == Z_NOTHING) return true;
    if (answer->outcome != Z_ERROR) return false;
    if (answer->size == 7 && memcmp(answer->payload, "Timeout", 7) == 0) {
        *pause_ms = 0;
        return true;
    }
    mp_value *problem = mp_read(answer->payload, answer->size);
    const mp_value *code = mp_field(problem, "code");
    const mp_value *after = mp_field(mp_field(problem, "detail"), "retry_after_s");
    bool busy = mp_is(code, "busy") || mp_is(code, "journal_failed");
    if (busy && after != NULL && after->type == MP_FLOAT) *pause_ms = (int)(1000 * after->number) + 1;
    bool repeat = busy || mp_is(code, "shutting_down");
    mp_release(problem);
    return repeat;
}

/* The answer's message, to be released with its bytes; NULL, and a line that says why, if it was refused. */
static mp_value *ask(robot *me, const char *key, const mp_buffer *message, uint8_t **bytes)
{
    int pause_ms = FIRST_PAUSE_MS;
    *bytes = NULL;
    for (int tried = 0; tried < TRIES && !message->failed; tried++) {
        z_answer answer = z_query(me->bus, key, message->bytes, message->size, TRY_MS);
        me->heard |= answer.outcome == Z_REPLY || answer.outcome == Z_ERROR;
        if (answer.outcome == Z_REPLY) {
            *bytes = answer.payload;
            return mp_read(answer.payload, answer.size);
        }
        int wait_ms = pause_ms;
        bool repeat = again(&answer, &wait_ms);
        if (!repeat || tried + 1 == TRIES) complain(key, &answer);
        free(answer.payload);
        /* Others than ours will not answer, however often they are asked, §13. */
        if (repeat && !me->heard && tried + 1 >= SILENCES && only_other_versions(me->bus)) return NULL;
        if (!repeat || !z_wait(me->bus, wait_ms)) return NULL;
        pause_ms = 2 * pause_ms < LONGEST_PAUSE_MS ? 2 * pause_ms : LONGEST_PAUSE_MS;
    }
    return NULL;
}

static bool join(robot *me)
{
    mp_buffer message = {0};
    uint8_t *bytes;
    mp_map(&message, 1);
    mp_str(&message, "map");
    mp_str(&message, me->map);
    mp_value *row = ask(me, "factorbus/v1/admin/create", &message, &bytes);
    me->epoch = whole(row, "epoch");
    bool fine = row != NULL;
    mp_release(row);
    free(bytes);
    mp_free(&message);
    return fine;
}

/* The whole estimate, after which deltas count. */
static bool look(robot *me)
{
    char key[200];
    uint8_t *bytes;
    mp_buffer message = {0};
    snprintf(key, sizeof key, "factorbus/v1/map/%s/ask/estimate", me->map);
    mp_map(&message, 0);
    /* A delta that comes while this is under way is older, or the next one shows the gap. */
    mp_value *told = ask(me, key, &message, &bytes);
    if (told != NULL) {
        memset(me->now.known, 0, sizeof me->now.known);
        apply(&me->now, told);
        me->now.live = true;
        me->now.gap = false;
    }
    bool fine = told != NULL;
    mp_release(told);
    free(bytes);
    mp_free(&message);
    return fine;
}

/* Until the estimate is of that revision. A second without news is a delta that got lost. */
static bool reach(robot *me, uint64_t revision)
{
    for (int waited_ms = 0; waited_ms < PATIENCE_MS; waited_ms += 10) {
        if (me->now.revision >= revision && !me->now.gap) return true;
        if (!z_wait(me->bus, 10)) return false;
        if ((me->now.gap || waited_ms % 1000 == 990) && !look(me)) return false;
    }
    fprintf(stderr, "revision %" PRIu64 " did not come\n", revision);
    return false;
}

/* ---- inserting, §6 ---- */

static void begin_insert(mp_buffer *out, uint64_t sequence, uint64_t epoch)
{
    mp_map(out, 4);
    mp_str(out, "sequence");
    mp_uint(out, sequence);
    mp_str(out, "epoch");
    mp_uint(out, epoch);
}

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* A pose of now: with a value it is held there, without one the service composes it from its factor. */
static void put_pose(mp_buffer *out, int64_t key, const double *fixed_at)
{
    const int64_t stamp = now_ns();
    mp_map(out, fixed_at ? 5 : 3);
    mp_str(out, "kind");
    mp_str(out, "se2");
    mp_str(out, "keys");
    mp_i64s(out, &key, 1);
    mp_str(out, "stamps");
    mp_i64s(out, &stamp, 1);
    if (fixed_at == NULL) return;
    mp_str(out, "values");
    mp_f64s(out, fixed_at, 3);
    mp_str(out, "fixed");
    mp_bool(out, true);
}

static void put_between(mp_buffer *out, int64_t first, int64_t second, const double *measured, const double *information)
{
    const int64_t pair[2] = {first, second};
    mp_map(out, 4);
    mp_str(out, "kind");
    mp_str(out, "between_se2");
    mp_str(out, "keys");
    mp_i64s(out, pair, 2);
    mp_str(out, "measured");
    mp_f64s(out, measured, 3);
    mp_str(out, "information");
    mp_f64s(out, information, 6);
}

static bool send_insert(robot *me, mp_buffer *message)
{
    char key[200];
    uint8_t *bytes;
    snprintf(key, sizeof key, "factorbus/v1/map/%s/in/%s", me->map, me->name);
    mp_value *accepted = ask(me, key, message, &bytes);
    bool fine = accepted != NULL && reach(me, whole(accepted, "revision"));
    mp_release(accepted);
    free(bytes);
    mp_free(message);
    return fine;
}

static bool insert_pose(robot *me, int index)
{
    mp_buffer message = {0};
    begin_insert(&message, ++me->sequence, me->epoch);
    mp_str(&message, "variables");
    mp_array(&message, 1);
    put_pose(&message, key_of('x', index), index == 0 ? HOME : NULL);
    mp_str(&message, "factors");
    mp_array(&message, index == 0 ? 0 : 1);
    if (index > 0) put_between(&message, key_of('x', index - 1), key_of('x', index), SIDE, ODOMETRY);
    return send_insert(me, &message);
}

static bool close_loop(robot *me)
{
    mp_buffer message = {0};
    begin_insert(&message, ++me->sequence, me->epoch);
    mp_str(&message, "variables");
    mp_array(&message, 0);
    mp_str(&message, "factors");
    mp_array(&message, 1);
    put_between(&message, key_of('x', POSES - 1), key_of('x', 0), HOME, CLOSURE);
    return send_insert(me, &message);
}

static void show(const robot *me, const char *when)
{
    const estimate *now = &me->now;
    printf("%s, revision %" PRIu64 ":\n", when, now->revision);
    for (int i = 0; i < POSES; i++) {
        if (!now->known[i]) continue;
        printf("x%d %.17g %.17g %.17g", i, now->poses[i][0], now->poses[i][1], now->poses[i][2]);
        if (now->stamps[i] != NO_STAMP) printf(" at %" PRId64 " ns", now->stamps[i]);
        printf("\n");
    }
}

static bool drive(robot *me)
{
    char key[200];
    snprintf(key, sizeof key, "factorbus/v1/map/%s/out/delta", me->map);
    if (!join(me) || !z_subscribe(me->bus, key)) return false;
    snprintf(key, sizeof key, "factorbus/v1/map/%s/live/client/%s", me->map, me->name);
    if (!z_announce(me->bus, key) || !look(me)) return false;
    for (int i = 0; i < POSES; i++)
        if (!insert_pose(me, i)) return false;
    show(me, "by odometry");
    if (!close_loop(me)) return false;
    show(me, "with the loop closed");
    return true;
}

int main(int count, char **arguments)
{
    if (count != 4 || strlen(arguments[3]) > 64) {
        fprintf(stderr, "usage: %s HOST PORT MAP\n", arguments[0]);
        return 2;
    }
    static robot me;
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    /* A name that nobody has used: one run, one name. */
    snprintf(me.name, sizeof me.name, "c-%08lx", (unsigned long)(now.tv_sec ^ (now.tv_nsec << 8)) & 0xffffffff);
    snprintf(me.map, sizeof me.map, "%s", arguments[3]);
    me.bus = z_open(arguments[1], arguments[2], on_delta, &me.now);
    if (me.bus == NULL) return 1;
    bool fine = drive(&me);
    z_close(me.bus);
    return fine ? 0 : 1;
}
