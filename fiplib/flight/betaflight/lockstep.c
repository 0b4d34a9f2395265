/* A clock that waits: preloaded into Betaflight SITL by sitl.py, so that nothing measured there depends on
 * how fast or how busy the machine is. The firmware itself is not changed; five functions of its C library are.
 *
 *   clock_gettime, nanosleep   With FIP_STEP, time passes in the firmware's main thread only: each look at the clock
 *                              takes READ_NS, each sleep what it asks for (but see ROUND_NS). It passes freely until
 *                              FIP_START ns; from then on each packet of the simulation grants FIP_STEP ns, and when
 *                              they are used up the main thread waits for the next packet.
 *   select                     A thread that waits for the next packet has dealt with the one before: that is when a
 *                              packet on the state port grants its time, and when one on the RC port is acknowledged.
 *   bind, sendto               All ports are shifted by FIP_OFFSET, and bound on the loopback interface only (the
 *                              firmware would listen on every interface).
 *
 * The pipe FIP_PIPE tells the simulation what happened: 'd' the granted time is used up, 'r' an RC packet was taken.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <netinet/in.h>
#include <pthread.h>
#include <semaphore.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum { STATE_PORT = 9003, RC_PORT = 9004 };
/* What the clock shows at the start, and how long a look at it takes. */
enum { BOOT_NS = 1000000000, READ_NS = 500 };
/* SITL sleeps 50 us of the machine's time after each round of its main loop, which hardware does not: with them the
 * gyro loop comes to 6.25 kHz instead of its 8 kHz. */
enum { ROUND_NS = 50000, PAUSE_NS = 5000 };

static pthread_t main_thread;
static sem_t granted;
static volatile int64_t now_ns = BOOT_NS;
static int64_t limit_ns = INT64_MAX, step_ns;
static int offset, tell = -1, state_fd = -1, rc_fd = -1;
static __thread int state_pending, rc_pending;

static int64_t number(const char *name)
{
    const char *text = getenv(name);
    return text ? atoll(text) : 0;
}

__attribute__((constructor)) static void start(void)
{
    prctl(PR_SET_PDEATHSIG, SIGKILL); /* never outlive the simulation, however that ends */
    main_thread = pthread_self();
    sem_init(&granted, 0, 0);
    offset = (int)number("FIP_OFFSET");
    step_ns = number("FIP_STEP");
    if (step_ns > 0) {
        limit_ns = BOOT_NS + number("FIP_START");
        tell = (int)number("FIP_PIPE");
    }
}

static void say(char what)
{
    if (tell >= 0 && write(tell, &what, 1) != 1)
        _exit(3); /* the simulation is gone */
}

static void pass(int64_t ns)
{
    now_ns += ns;
    while (now_ns >= limit_ns) {
        say('d');
        while (sem_wait(&granted) != 0)
            ;
        limit_ns += step_ns;
    }
}

int clock_gettime(clockid_t clock, struct timespec *ts)
{
    if (clock != CLOCK_MONOTONIC || step_ns <= 0)
        return (int)syscall(SYS_clock_gettime, clock, ts);
    if (pthread_equal(pthread_self(), main_thread))
        pass(READ_NS);
    int64_t now = now_ns;
    ts->tv_sec = now / 1000000000;
    ts->tv_nsec = now % 1000000000;
    return 0;
}

int nanosleep(const struct timespec *wanted, struct timespec *left)
{
    if (step_ns <= 0 || !pthread_equal(pthread_self(), main_thread))
        return (int)syscall(SYS_clock_nanosleep, CLOCK_MONOTONIC, 0, wanted, left);
    int64_t ns = wanted->tv_sec * 1000000000LL + wanted->tv_nsec;
    pass(ns == ROUND_NS ? PAUSE_NS : ns);
    return 0;
}

int select(int count, fd_set *in, fd_set *out, fd_set *bad, struct timeval *timeout)
{
    static int (*real)(int, fd_set *, fd_set *, fd_set *, struct timeval *);
    if (!real)
        real = (int (*)(int, fd_set *, fd_set *, fd_set *, struct timeval *))dlsym(RTLD_NEXT, "select");
    if (state_pending) {
        state_pending = 0;
        sem_post(&granted);
    }
    if (rc_pending) {
        rc_pending = 0;
        say('r');
    }
    int ready = real(count, in, out, bad, timeout);
    if (ready > 0 && in) {
        state_pending = state_fd >= 0 && FD_ISSET(state_fd, in);
        rc_pending = rc_fd >= 0 && FD_ISSET(rc_fd, in);
    }
    return ready;
}

int bind(int fd, const struct sockaddr *address, socklen_t length)
{
    static int (*real)(int, const struct sockaddr *, socklen_t);
    if (!real)
        real = (int (*)(int, const struct sockaddr *, socklen_t))dlsym(RTLD_NEXT, "bind");
    if (address->sa_family == AF_INET) {
        struct sockaddr_in here = *(const struct sockaddr_in *)address;
        int port = ntohs(here.sin_port);
        if (port == STATE_PORT)
            state_fd = fd;
        if (port == RC_PORT)
            rc_fd = fd;
        here.sin_port = htons((uint16_t)(port + offset));
        here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        return real(fd, (const struct sockaddr *)&here, sizeof here);
    }
    if (address->sa_family == AF_INET6) {
        struct sockaddr_in6 here = *(const struct sockaddr_in6 *)address;
        here.sin6_port = htons((uint16_t)(ntohs(here.sin6_port) + offset));
        here.sin6_addr = in6addr_loopback;
        return real(fd, (const struct sockaddr *)&here, sizeof here);
    }
    return real(fd, address, length);
}

ssize_t sendto(int fd, const void *data, size_t size, int flags, const struct sockaddr *address, socklen_t length)
{
    static ssize_t (*real)(int, const void *, size_t, int, const struct sockaddr *, socklen_t);
    if (!real)
        real = (ssize_t(*)(int, const void *, size_t, int, const struct sockaddr *, socklen_t))dlsym(RTLD_NEXT, "sendto");
    if (address && address->sa_family == AF_INET) {
        struct sockaddr_in there = *(const struct sockaddr_in *)address;
        there.sin_port = htons((uint16_t)(ntohs(there.sin_port) + offset));
        return real(fd, data, size, flags, (const struct sockaddr *)&there, sizeof there);
    }
    return real(fd, data, size, flags, address, length);
}
