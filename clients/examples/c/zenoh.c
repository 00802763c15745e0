#define _POSIX_C_SOURCE 200809L
#include "zenoh.h"
#include "zenoh_bytes.h"

#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum {
    /* Messages of the transport, … */
    INIT = 0x01, OPEN = 0x02, CLOSE = 0x03, KEEP_ALIVE = 0x04, FRAME = 0x05, FRAGMENT = 0x06,
    /* … of the network, within frames, … */
    OAM = 0x1f, DECLARE = 0x1e, PUSH = 0x1d, REQUEST = 0x1c, RESPONSE = 0x1b, RESPONSE_FINAL = 0x1a, INTEREST = 0x19,
    /* … what they carry, and what is declared. */
    PUT = 0x01, DEL = 0x02, QUERY = 0x03, REPLY = 0x04, ERR = 0x05,
    D_KEY = 0x00, D_SUBSCRIBER = 0x02, D_TOKEN = 0x06, D_FINAL = 0x1a,
    /* Of an interest: in keys and tokens, within a key expression that follows whole. */
    I_TOKENS = 0x09, I_WITHIN = 0x30,
    VERSION = 9, CLIENT = 2, RESOLUTION = 0x0a, /* numbers of frames and requests have 32 bits */
    LEASE_MS = 10000, BEAT_MS = 2500, OPENING_MS = 10000,
    KEYS = 256, LONGEST_KEY = 512, LARGEST = 256 << 20,
};

struct z_session {
    int socket;
    uint64_t next_frame, next_request, next_declared;
    int64_t last_sent_ms;
    z_on_sample on_sample;
    void *context;
    uint64_t waiting_for; /* the query that is out, 0: none */
    bool ended;           /* it has ended, or its first reply is here */
    z_answer answer;
    uint64_t looking_for; /* the look at tokens that is out, 0: none */
    bool looked;          /* all of them are here */
    z_on_token on_token;
    void *token_context;
    uint8_t *parts; /* of a message in fragments */
    size_t parts_size;
    char *keys[KEYS]; /* that the other side has given a number */
    uint8_t batch[BATCH];
};

static int64_t now_ms(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

/* ---- the link: batches behind their length, two bytes, the lower first ---- */

static bool send_all(z_session *session, const uint8_t *bytes, size_t size)
{
    for (size_t sent = 0; sent < size;) {
        ssize_t more = send(session->socket, bytes + sent, size - sent, MSG_NOSIGNAL);
        if (more <= 0) return false;
        sent += (size_t)more;
    }
    session->last_sent_ms = now_ms();
    return true;
}

static bool send_batch(z_session *session, const writer *out)
{
    uint8_t length[2] = {(uint8_t)out->size, (uint8_t)(out->size >> 8)};
    return !out->full && send_all(session, length, 2) && send_all(session, out->bytes, out->size);
}

/* One network message, in a frame of its own. */
static bool send_message(z_session *session, const writer *message)
{
    writer *out = malloc(sizeof *out);
    if (out == NULL) return false;
    out->size = 0;
    out->full = message->full;
    put_byte(out, FRAME | F1); /* reliable */
    put_number(out, session->next_frame++);
    put(out, message->bytes, message->size);
    bool sent = send_batch(session, out);
    free(out);
    return sent;
}

static bool receive_all(z_session *session, uint8_t *into, size_t size, int64_t until_ms)
{
    for (size_t got = 0; got < size;) {
        struct pollfd ready = {session->socket, POLLIN, 0};
        int64_t left = until_ms - now_ms();
        if (poll(&ready, 1, left > 0 ? (int)left : 0) <= 0) return false;
        ssize_t more = recv(session->socket, into + got, size - got, 0);
        if (more <= 0) return false;
        got += (size_t)more;
    }
    return true;
}

static bool receive_batch(z_session *session, reader *in)
{
    uint8_t length[2];
    int64_t until = now_ms() + OPENING_MS; /* it has begun to come: the rest does not take long */
    if (!receive_all(session, length, 2, until)) return false;
    size_t size = (size_t)length[0] | (size_t)length[1] << 8;
    if (!receive_all(session, session->batch, size, until)) return false;
    *in = (reader){session->batch, session->batch + size, false};
    return true;
}

/* ---- what comes ---- */

/* A key: what a number stands for, if one is given, and what follows. */
static void read_key(z_session *session, reader *in, uint8_t header, char *key, size_t room)
{
    uint64_t begin = number(in);
    reader rest = header & F1 ? part(in, number(in)) : (reader){in->at, in->at, in->bad};
    const char *known = begin > 0 && begin < KEYS && session->keys[begin] ? session->keys[begin] : "";
    if (begin > 0 && !*known) in->bad = true;
    snprintf(key, room, "%s%.*s", known, (int)(rest.end - rest.at), (const char *)rest.at);
}

static void take_answer(z_session *session, z_outcome outcome, reader payload)
{
    size_t size = (size_t)(payload.end - payload.at);
    session->answer = (z_answer){outcome, malloc(size ? size : 1), size};
    if (session->answer.payload != NULL) memcpy(session->answer.payload, payload.at, size);
    session->ended = true;
}

/* Time and encoding, where they are, of a Put; of an Err it has no time. */
static void skip_head(reader *in, uint8_t header, bool time, bool encoding)
{
    if (time) {
        number(in);
        part(in, number(in));
    }
    if (encoding && number(in) & 1) part(in, number(in));
    skip_extensions(in, header);
}

static bool read_put(reader *in, reader *payload)
{
    uint8_t header = byte(in);
    skip_head(in, header, header & F1, (header & ID) == PUT && header & F2);
    *payload = (header & ID) == PUT ? part(in, number(in)) : (reader){in->at, in->at, false};
    return (header & ID) == PUT && !in->bad;
}

static void on_push(z_session *session, reader *in, uint8_t header)
{
    char key[LONGEST_KEY];
    reader payload;
    read_key(session, in, header, key, sizeof key);
    skip_extensions(in, header);
    if (read_put(in, &payload) && session->on_sample != NULL)
        session->on_sample(session->context, key, payload.at, (size_t)(payload.end - payload.at));
}

static void on_response(z_session *session, reader *in, uint8_t header)
{
    char key[LONGEST_KEY];
    uint64_t request = number(in);
    read_key(session, in, header, key, sizeof key);
    skip_extensions(in, header);
    uint8_t body = byte(in);
    reader payload;
    bool is_error = (body & ID) == ERR;
    if (is_error) {
        skip_head(in, body, false, body & F2);
        payload = part(in, number(in));
    } else {
        if (body & F1) byte(in); /* consolidation */
        skip_extensions(in, body);
        if (!read_put(in, &payload)) return;
    }
    if (!in->bad && request == session->waiting_for && !session->ended)
        take_answer(session, is_error ? Z_ERROR : Z_REPLY, payload);
}

static void on_declare(z_session *session, reader *in, uint8_t header)
{
    char key[LONGEST_KEY];
    uint64_t interest = header & F1 ? number(in) : 0;
    bool ours = interest > 0 && interest == session->looking_for;
    skip_extensions(in, header);
    uint8_t what = byte(in);
    bool keyed = (what & ID) == D_KEY || (what & ID) == D_SUBSCRIBER || (what & ID) == 0x04 || (what & ID) == D_TOKEN;
    uint64_t declared = (what & ID) == D_FINAL ? 0 : number(in);
    if (keyed) {
        read_key(session, in, what, key, sizeof key);
        if ((what & ID) == D_KEY && declared < KEYS && !in->bad) {
            free(session->keys[declared]);
            session->keys[declared] = malloc(strlen(key) + 1);
            if (session->keys[declared] != NULL) memcpy(session->keys[declared], key, strlen(key) + 1);
        }
    }
    skip_extensions(in, what);
    if (ours && (what & ID) == D_TOKEN && !in->bad) session->on_token(session->token_context, key);
    if (ours && (what & ID) == D_FINAL) session->looked = true;
}

static void on_interest(z_session *session, reader *in, uint8_t header)
{
    char key[LONGEST_KEY];
    number(in);
    if (header & (F1 | F2)) {
        uint8_t options = byte(in);
        if (options & 0x10) read_key(session, in, options & 0x20 ? F1 : 0, key, sizeof key);
    }
    skip_extensions(in, header);
}

static void on_oam(reader *in, uint8_t header)
{
    number(in);
    skip_extensions(in, header);
    if ((header & (F1 | F2)) == F1) number(in);
    if ((header & (F1 | F2)) == F2) part(in, number(in));
}

/* One network message; false if it is none, and nothing is taken then. */
static bool read_message(z_session *session, reader *in)
{
    if (in->at >= in->end || (*in->at & ID) < INTEREST) return false;
    uint8_t header = byte(in);
    switch (header & ID) {
    case PUSH: on_push(session, in, header); break;
    case RESPONSE: on_response(session, in, header); break;
    case RESPONSE_FINAL:
        if (number(in) == session->waiting_for) session->ended = true;
        skip_extensions(in, header);
        break;
    case DECLARE: on_declare(session, in, header); break;
    case INTEREST: on_interest(session, in, header); break;
    case OAM: on_oam(in, header); break;
    default: in->bad = true; /* a request: we declare nothing that answers */
    }
    return !in->bad;
}

/* A part of a message that is larger than a batch; the last one makes it whole. */
static bool on_fragment(z_session *session, reader *in, uint8_t header)
{
    number(in);
    skip_extensions(in, header);
    size_t size = (size_t)(in->end - in->at);
    uint8_t *more = session->parts_size + size > LARGEST ? NULL : realloc(session->parts, session->parts_size + size + 1);
    if (in->bad || more == NULL) return false;
    memcpy(more + session->parts_size, in->at, size);
    session->parts = more;
    session->parts_size += size;
    in->at = in->end;
    if (header & F2) return true; /* more to come */
    reader whole = {session->parts, session->parts + session->parts_size, false};
    session->parts_size = 0;
    return read_message(session, &whole);
}

static bool read_batch(z_session *session, reader *in)
{
    while (in->at < in->end && !in->bad) {
        uint8_t header = byte(in);
        switch (header & ID) {
        case KEEP_ALIVE: skip_extensions(in, header); break;
        case FRAME:
            number(in);
            skip_extensions(in, header);
            while (read_message(session, in)) {}
            break;
        case FRAGMENT:
            if (!on_fragment(session, in, header)) return false;
            break;
        default: return false; /* CLOSE, or what nobody has told us of */
        }
    }
    return !in->bad;
}

/* Until something ended, or time is up; false when the connection is gone. */
static bool pump(z_session *session, int64_t until_ms, const bool *ended)
{
    while (!*ended) {
        int64_t now = now_ms(), beat = session->last_sent_ms + BEAT_MS;
        if (now >= until_ms) return true;
        if (now >= beat) {
            writer *out = calloc(1, sizeof *out);
            if (out != NULL) put_byte(out, KEEP_ALIVE);
            bool sent = out != NULL && send_batch(session, out);
            free(out);
            if (!sent) return false;
            continue;
        }
        struct pollfd ready = {session->socket, POLLIN, 0};
        int64_t pause = (until_ms < beat ? until_ms : beat) - now;
        int found = poll(&ready, 1, (int)pause);
        if (found < 0) return false;
        reader in;
        if (found > 0 && !(receive_batch(session, &in) && read_batch(session, &in))) return false;
    }
    return true;
}

/* ---- opening ---- */

static int connect_to(const char *host, const char *port)
{
    struct addrinfo wanted = {.ai_socktype = SOCK_STREAM}, *found = NULL;
    int made = -1, yes = 1;
    if (getaddrinfo(host, port, &wanted, &found) != 0) return -1;
    for (struct addrinfo *each = found; each != NULL && made < 0; each = each->ai_next) {
        made = socket(each->ai_family, each->ai_socktype, each->ai_protocol);
        if (made >= 0 && connect(made, each->ai_addr, each->ai_addrlen) != 0) {
            close(made);
            made = -1;
        }
    }
    freeaddrinfo(found);
    if (made >= 0) setsockopt(made, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    return made;
}

static bool random_bytes(uint8_t *into, size_t size)
{
    FILE *source = fopen("/dev/urandom", "rb");
    bool fine = source != NULL && fread(into, 1, size, source) == size;
    if (source != NULL) fclose(source);
    into[size - 1] |= 1; /* an id has no leading zero */
    return fine;
}

/* InitSyn, InitAck with a cookie, OpenSyn with the cookie, OpenAck. */
static bool shake_hands(z_session *session)
{
    writer *out = calloc(1, sizeof *out);
    uint8_t name[16];
    reader in;
    if (out == NULL || !random_bytes(name, sizeof name)) {
        free(out);
        return false;
    }
    put_byte(out, INIT | F2);
    put_byte(out, VERSION);
    put_byte(out, (sizeof name - 1) << 4 | CLIENT);
    put(out, name, sizeof name);
    put_byte(out, RESOLUTION);
    put(out, "\xff\xff", 2);
    bool fine = send_batch(session, out) && receive_batch(session, &in);
    uint8_t header = fine ? byte(&in) : 0;
    fine = fine && (header & ID) == INIT && header & F1 && byte(&in) == VERSION;
    if (fine) {
        part(&in, (uint64_t)(byte(&in) >> 4) + 1);
        if (header & F2) part(&in, 3);
        reader cookie = part(&in, number(&in));
        out->size = 0;
        put_byte(out, OPEN);
        put_number(out, LEASE_MS);
        put_number(out, session->next_frame);
        put_number(out, (uint64_t)(cookie.end - cookie.at));
        put(out, cookie.at, (size_t)(cookie.end - cookie.at));
        fine = !in.bad && send_batch(session, out) && receive_batch(session, &in);
        header = fine ? byte(&in) : 0;
        fine = fine && (header & ID) == OPEN && header & F1;
    }
    free(out);
    return fine;
}

z_session *z_open(const char *host, const char *port, z_on_sample on_sample, void *context)
{
    z_session *session = calloc(1, sizeof *session);
    if (session == NULL) return NULL;
    session->on_sample = on_sample;
    session->context = context;
    session->next_request = session->next_declared = 1;
    session->socket = connect_to(host, port);
    if (session->socket < 0 || !shake_hands(session)) {
        fprintf(stderr, "nobody speaks Zenoh at %s:%s; start `factorbus serve`, or check the address\n", host, port);
        z_close(session);
        return NULL;
    }
    return session;
}

void z_close(z_session *session)
{
    if (session == NULL) return;
    if (session->socket >= 0) {
        writer *out = calloc(1, sizeof *out);
        if (out != NULL) {
            put_byte(out, CLOSE | F1);
            put_byte(out, 0);
            send_batch(session, out);
        }
        free(out);
        close(session->socket);
    }
    for (int i = 0; i < KEYS; i++) free(session->keys[i]);
    free(session->parts);
    free(session);
}

/* ---- what is asked ---- */

static bool declare(z_session *session, uint8_t what, const char *key)
{
    writer *out = calloc(1, sizeof *out);
    if (out == NULL) return false;
    put_byte(out, DECLARE);
    put_byte(out, (uint8_t)(what | F1 | F2)); /* the whole key follows */
    put_number(out, session->next_declared++);
    put_key(out, key);
    bool sent = send_message(session, out);
    free(out);
    return sent;
}

bool z_subscribe(z_session *session, const char *key) { return declare(session, D_SUBSCRIBER, key); }
bool z_announce(z_session *session, const char *key) { return declare(session, D_TOKEN, key); }

z_answer z_query(z_session *session, const char *key, const void *payload, size_t size, int timeout_ms)
{
    writer *out = calloc(1, sizeof *out);
    bool sent = out != NULL;
    session->waiting_for = session->next_request++;
    session->ended = false;
    session->answer = (z_answer){Z_NOTHING, NULL, 0};
    if (sent) {
        put_byte(out, (uint8_t)(REQUEST | F1 | F2 | EXTENDED));
        put_number(out, session->waiting_for);
        put_key(out, key);
        put_byte(out, 0x06 | EXT_INT); /* for how long it is out */
        put_number(out, (uint64_t)timeout_ms);
        put_byte(out, (uint8_t)(QUERY | F1 | EXTENDED));
        put_byte(out, 1);              /* consolidation: none, so that the first reply comes at once */
        put_byte(out, 0x03 | EXT_BYTES); /* the payload, behind its encoding: 0, just bytes */
        put_number(out, size + 1);
        put_byte(out, 0);
        put(out, payload, size);
        sent = send_message(session, out);
    }
    free(out);
    if (!sent || !pump(session, now_ms() + timeout_ms, &session->ended)) {
        free(session->answer.payload);
        session->answer = (z_answer){Z_BROKEN, NULL, 0};
    }
    session->waiting_for = 0;
    return session->answer;
}

bool z_look(z_session *session, const char *key, z_on_token on_token, void *context, int timeout_ms)
{
    writer *out = calloc(1, sizeof *out);
    bool sent = out != NULL;
    session->looking_for = session->next_request++;
    session->looked = false;
    session->on_token = on_token;
    session->token_context = context;
    if (sent) {
        put_byte(out, INTEREST | F1); /* in what there is now */
        put_number(out, session->looking_for);
        put_byte(out, I_TOKENS | I_WITHIN);
        put_key(out, key);
        sent = send_message(session, out);
    }
    free(out);
    bool fine = sent && pump(session, now_ms() + timeout_ms, &session->looked);
    session->looking_for = 0;
    return fine;
}

bool z_wait(z_session *session, int timeout_ms)
{
    bool never = false;
    return pump(session, now_ms() + timeout_ms, &never);
}
